"""Simulated controllers, directly and on a pseudo-terminal in real time, for the serial driver."""

from __future__ import annotations

import contextlib
import os
import select
import tempfile
import threading
import time
import tty
from collections import deque
from collections.abc import Callable, Iterator
from pathlib import Path

from drivers.motors.protocols.differential_drive import DifferentialDrive
from drivers.motors.protocols.motor_protocol import Framer, T, Transaction
from drivers.motors.protocols.protocol_registry import PROTOCOLS
from drivers.motors.serial_motor import SerialMotor
from drivers.motors.simulated.simulated_base import STEP_S, MotionLimits, Pose, SimulatedBase
from drivers.motors.simulated.simulated_line import SimulatedLine
from tests.contract.simulated_controllers import SIMULATED_CONTROLLERS, SimulatedController, SimulatedVesc

READ_LIMIT_BYTES = 4096
POSES_KEPT = 1000  # Number of poses that are kept with their times: those of some seconds.
LONGEST_ABSENCE_S = 0.05  # a thread that was not scheduled for longer does not advance: the host was not late


class PtyMotor:
    """A controller on a pty in real time; a thread stands for the processor of the real device."""

    def __init__(self, controller: SimulatedController | None = None) -> None:
        """Open the pty; `port` is the path for the driver."""
        self.controller = controller or SimulatedLine()
        self.unsent = 0  # replies dropped because the host did not read
        self.drop_replies = False  # fault: commands are carried out without a reply
        self.drop_input = False  # fault: received bytes are ignored
        self.garbage = b""  # fault: sent before each reply
        self.poses: deque[tuple[int, Pose]] = deque(maxlen=POSES_KEPT)  # time (CLOCK_MONOTONIC) [ns] and pose
        device, self._host = os.openpty()
        tty.setraw(self._host)  # kept open: without an open host side, reads of the device side fail
        os.set_blocking(device, False)
        self._device: int | None = device  # None: unplugged
        # A name of its own, as udev gives it: the system gives the number of a closed pty to the next one that opens.
        self._folder = tempfile.TemporaryDirectory(prefix="omnid-motor-")
        os.chmod(self._folder.name, 0o755)  # other users may try to open it
        self.port = str(Path(self._folder.name, "tty"))
        os.symlink(os.ttyname(self._host), self.port)
        self._expiring, self._unplugging = threading.Event(), threading.Event()
        self._wake_read, self._wake_write = os.pipe()
        self._thread = threading.Thread(target=self._serve, name="simulated-motor", daemon=True)
        self._thread.start()

    @property
    def base(self) -> SimulatedBase:
        """The simulated base."""
        return self.controller.base

    def expire(self) -> None:
        """Let the watchdog stop the wheels at once."""
        self._expiring.set()
        while self._expiring.is_set() and self._thread.is_alive():
            time.sleep(STEP_S)

    def unplug(self) -> None:
        """Close the pty permanently, as a pulled plug does; the controller runs on, its watchdog stops the wheels."""
        self._unplugging.set()
        while self._device is not None and self._thread.is_alive():
            time.sleep(STEP_S)

    def send(self, data: bytes) -> None:
        """Send bytes; drop them where the host does not read."""
        with contextlib.suppress(BlockingIOError):
            if self._device is not None and os.write(self._device, data) == len(data):
                return
        self.unsent += 1

    def close(self) -> None:
        """End the thread and close the pty; a second call does nothing."""
        if not self._thread.is_alive():
            return
        os.write(self._wake_write, b"x")
        self._thread.join()
        self._close_pty()
        for descriptor in (self._wake_read, self._wake_write):
            os.close(descriptor)

    def _close_pty(self) -> None:
        if self._device is not None:
            self._folder.cleanup()
            os.close(self._device)
            os.close(self._host)
            self._device = None

    def _serve(self) -> None:
        last_s = time.monotonic()
        while True:
            sources = [self._wake_read] if self._device is None else [self._wake_read, self._device]
            readable, _, _ = select.select(sources, [], [], STEP_S)
            now_s = time.monotonic()
            self.base.advance(min(now_s - last_s, LONGEST_ABSENCE_S))
            last_s = now_s
            self.poses.append((round(now_s * 1e9), self.base.pose))
            if self._wake_read in readable:
                return
            if self._expiring.is_set():
                self.base.expire()
                self._expiring.clear()
            if self._unplugging.is_set():
                self._close_pty()
            elif readable and self._device is not None:
                self._receive(os.read(self._device, READ_LIMIT_BYTES))

    def _receive(self, data: bytes) -> None:
        if self.drop_input:
            return
        replies = self.controller.feed(data)
        if replies and not self.drop_replies:
            self.send(self.garbage + replies)


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
