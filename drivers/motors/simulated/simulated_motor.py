"""A simulated motor controller as a motor driver, whose time passes by a clock."""

from __future__ import annotations

from collections.abc import Callable

from drivers.errors import DriverError
from drivers.motor import MotorStatus, VelocityCommand, stop_command
from drivers.motors.protocols.differential_drive import DifferentialDrive
from drivers.motors.protocols.line_protocol import LineProtocol
from drivers.motors.protocols.motor_protocol import T, Transaction
from drivers.motors.simulated.simulated_base import LONGEST_ADVANCE_S, SimulatedBase
from drivers.motors.simulated.simulated_line import SimulatedLine


class SimulatedMotor:
    """A MotorDriver whose bytes reach the controller at once, and whose base moves as time passes by a clock.

    It speaks the line protocol, whatever that of the robot is: what is simulated is the base. Like the serial driver it
    begins with a stop, and sends one after a pause in which the watchdog may have expired.
    """

    def __init__(self, drive: DifferentialDrive, watchdog_ms: int, clock_ns: Callable[[], int]) -> None:
        self._protocol, self._controller, self._clock_ns = LineProtocol(drive), SimulatedLine(drive), clock_ns
        self._framer = self._protocol.framer()
        self._longest_pause_ns = watchdog_ms * 1_000_000 // 2
        self._now_ns = self._answered_ns = clock_ns()
        self.status: MotorStatus | None = None  # the last reply
        self.cut = False  # fault: no byte arrives at either end
        self._run(self._protocol.connect(watchdog_ms))
        self._run(self._protocol.drive(stop_command(0), clock_ns() * 1e-9))

    @property
    def base(self) -> SimulatedBase:
        """The simulated base."""
        return self._controller.base

    def advance(self) -> None:
        """Let the base move until now."""
        now_ns = self._clock_ns()
        self.base.advance(min((now_ns - self._now_ns) * 1e-9, LONGEST_ADVANCE_S))
        self._now_ns = now_ns

    def send(self, command: VelocityCommand) -> MotorStatus:
        """Send a command and return the controller's reply; DriverError without one."""
        self.advance()
        self.status = None
        if self._now_ns - self._answered_ns > self._longest_pause_ns:
            self._run(self._protocol.drive(stop_command(0), self._now_ns * 1e-9))
        self.status = self._run(self._protocol.drive(command, self._now_ns * 1e-9))
        self._answered_ns = self._now_ns
        return self.status

    def close(self) -> None:
        """Stop the wheels."""
        self._run(self._protocol.drive(stop_command(0), self._clock_ns() * 1e-9))

    def _run(self, transaction: Transaction[T]) -> T:
        try:
            frames = self._exchange(next(transaction))
            while frames:
                frames = [*frames[1:], *self._exchange(transaction.send(frames[0]))]
        except StopIteration as done:
            result: T = done.value
            return result
        raise DriverError("the simulated motor controller gave no answer")

    def _exchange(self, data: bytes) -> list[bytes]:
        if self.cut or not data:
            return []
        return self._framer.feed(self._controller.feed(data))
