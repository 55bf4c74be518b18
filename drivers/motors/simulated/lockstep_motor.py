"""Driver of a simulated motor controller in simulated time: the real protocol's bytes, without a port."""

from __future__ import annotations

from collections.abc import Callable

from drivers.errors import DriverError
from drivers.motor import MotorStatus, VelocityCommand, stop_command
from drivers.motors.protocols.motor_protocol import MotorProtocol, T, Transaction
from drivers.motors.simulated.simulated_motor import SimulatedController


class LockstepMotor:
    """A MotorDriver whose bytes reach the controller at once; like the serial driver it begins with a stop."""

    def __init__(
        self, protocol: MotorProtocol, controller: SimulatedController, watchdog_ms: int, clock_ns: Callable[[], int]
    ) -> None:
        """Connect; DriverError where the controller does not take the watchdog's time."""
        self._protocol, self._controller, self._clock_ns = protocol, controller, clock_ns
        self._framer = protocol.framer()
        self.status: MotorStatus | None = None  # the last reply
        self.cut = False  # fault: no byte arrives at either end
        self._run(protocol.connect(watchdog_ms))
        self._run(protocol.drive(stop_command(0), clock_ns() * 1e-9))

    def send(self, command: VelocityCommand) -> MotorStatus:
        """Send a command and return the controller's reply; DriverError without one."""
        self.status = None
        self.status = self._run(self._protocol.drive(command, self._clock_ns() * 1e-9))
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
