"""A controller's protocol and its simulation, connected by a real pty or directly."""

from __future__ import annotations

import contextlib
import time
from collections.abc import Callable, Iterator

from drivers.motors.protocols.differential_drive import DifferentialDrive
from drivers.motors.protocols.motor_protocol import Framer, T, Transaction
from drivers.motors.protocols.protocol_registry import PROTOCOLS
from drivers.motors.serial_motor import SerialMotor
from drivers.motors.simulated.simulated_base import MotionLimits
from drivers.motors.simulated.simulated_line import SimulatedLine
from tests.contract.pty_motor import PtyMotor
from tests.contract.simulated_controllers import SIMULATED_CONTROLLERS, SimulatedController, SimulatedVesc

NAMES = sorted(PROTOCOLS)
PATIENCE_S = 20.0  # bounds a wait on a loaded machine; not a measured limit
REPLY_S = 2.0
LONG_MS = 10_000
SHORT_MS = 100
BASE = DifferentialDrive(track_m=0.4, wheel_radius_m=0.08, max_wheel_mps=1.0, gear=12.0)
INSTANT = MotionLimits(acceleration_mps2=1e4, yaw_acceleration_radps2=1e5)


def controller_of(name: str, drive: DifferentialDrive = BASE, watchdog_ms: int = LONG_MS) -> SimulatedController:
    """Return the simulated controller; it follows the yaw rate even where it could steer to a heading."""
    if name == "vesc":
        return SimulatedVesc(drive, watchdog_ms)
    return SimulatedLine(drive, heading_input=False) if name == "line" else SIMULATED_CONTROLLERS[name](drive)


def run(transaction: Transaction[T], controller: SimulatedController, framer: Framer) -> T:
    """Run a transaction with a simulated controller and return its result."""
    try:
        data = next(transaction)
        while True:
            frames = framer.feed(controller.feed(data))
            assert frames, "the simulated controller does not reply"
            data = b"".join([transaction.send(frame) for frame in frames])
    except StopIteration as done:
        return done.value  # type: ignore[no-any-return]


@contextlib.contextmanager
def connected_motor(
    name: str, drive: DifferentialDrive = BASE, *, watchdog_ms: int = LONG_MS, timeout_s: float = REPLY_S
) -> Iterator[tuple[SerialMotor, PtyMotor]]:
    """Yield a driver and the simulated motor that it is connected to."""
    with contextlib.closing(PtyMotor(controller_of(name, drive, watchdog_ms))) as simulated:
        protocol = PROTOCOLS[name](drive)
        motor = SerialMotor(simulated.port, protocol, timeout_s=timeout_s, watchdog_ms=watchdog_ms,
                            connect_s=PATIENCE_S)  # fmt: skip
        with contextlib.closing(motor):
            yield motor, simulated


def until(condition: Callable[[], bool]) -> bool:
    """Wait for a condition; False if it is not met in time."""
    deadline = time.monotonic() + PATIENCE_S
    while time.monotonic() < deadline:
        if condition():
            return True
        time.sleep(0.005)
    return False
