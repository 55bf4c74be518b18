"""A controller's protocol and its twin, over a real pty or without one."""

from __future__ import annotations

import contextlib
import time
from collections.abc import Callable, Iterator

from drivers.motors.differential_drive import DifferentialDrive
from drivers.motors.motor_protocol import Framer, T, Transaction
from drivers.motors.protocols.protocol_registry import PROTOCOLS
from drivers.motors.serial_motor import SerialMotor
from drivers.motors.simulated.controller_registry import SIMULATED_CONTROLLERS
from drivers.motors.simulated.simulated_base import MotionLimits
from drivers.motors.simulated.simulated_line import SimulatedLine
from drivers.motors.simulated.simulated_motor import SimulatedController, SimulatedMotor
from drivers.motors.simulated.simulated_vesc import SimulatedVesc

NAMES = sorted(PROTOCOLS)
PATIENCE_S = 20.0  # bounds a wait on a loaded machine; nothing is measured against it
ANSWER_S = 2.0
LONG_MS = 10_000
BASE = DifferentialDrive(track_m=0.4, wheel_radius_m=0.08, max_wheel_mps=1.0, gear=12.0, ticks_per_turn=300.0)
INSTANT = MotionLimits(acceleration_mps2=1e4, yaw_acceleration_radps2=1e5)


def controller_of(name: str, drive: DifferentialDrive = BASE, watchdog_ms: int = LONG_MS) -> SimulatedController:
    """The twin; it follows the yaw rate even where it could steer to a heading."""
    if name == "vesc":
        return SimulatedVesc(drive, watchdog_ms)
    return SimulatedLine(drive, heading_input=False) if name == "line" else SIMULATED_CONTROLLERS[name](drive)


def shortest_watchdog_ms(name: str) -> int:
    """What can be asked of the controller and is soon over."""
    return 2000 if name == "ros_arduino_bridge" else 100


def answer(script: Transaction[T], controller: SimulatedController, framer: Framer) -> T:
    """What a script returns that talks to a twin directly."""
    try:
        data = next(script)
        while True:
            frames = framer.feed(controller.feed(data))
            assert frames, "the twin has nothing to say to it"
            data = b"".join([script.send(frame) for frame in frames])
    except StopIteration as done:
        return done.value  # type: ignore[no-any-return]


@contextlib.contextmanager
def connected_motor(
    name: str, drive: DifferentialDrive = BASE, *, watchdog_ms: int = LONG_MS, timeout_s: float = ANSWER_S
) -> Iterator[tuple[SerialMotor, SimulatedMotor]]:
    """Both ends of a pty, connected."""
    with contextlib.closing(SimulatedMotor(controller_of(name, drive, watchdog_ms))) as twin:
        protocol = PROTOCOLS[name](drive)
        motor = SerialMotor(twin.port, protocol, timeout_s=timeout_s, watchdog_ms=watchdog_ms, connect_s=PATIENCE_S)
        with contextlib.closing(motor):
            yield motor, twin


def until(condition: Callable[[], bool]) -> bool:
    """Waits for a condition and gives whether it came."""
    deadline = time.monotonic() + PATIENCE_S
    while time.monotonic() < deadline:
        if condition():
            return True
        time.sleep(0.005)
    return False
