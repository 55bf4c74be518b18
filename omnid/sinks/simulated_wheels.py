"""The simulated base of a replay: it takes the lock-step commands on the log's own clock."""

from __future__ import annotations

from drivers.motor import VelocityCommand, is_stop, stop_command
from drivers.motors.protocols.protocol_registry import motor_protocol
from drivers.motors.simulated.simulated_base import LONGEST_ADVANCE_S, SimulatedBase
from drivers.motors.simulated.simulated_motor import LockstepMotor, simulated_controller
from omnid.controller.motor_settings import MotorSettings


class SimulatedWheels:
    """Sends commands through the configured protocol to a simulated motor controller, and turns its wheels.

    A busy computer makes no command late: time passes for this base only from one command's stamp to the next.
    """

    def __init__(self, settings: MotorSettings) -> None:
        drive = settings.drive.geometry()
        self._controller = simulated_controller(settings.protocol, drive)
        self._now_ns, self._moves = 0, False
        self._rearm_s = 0.5e-3 * settings.watchdog_ms
        self._sent = self._stops = 0
        self._motor = LockstepMotor(
            motor_protocol(settings.protocol)(drive), self._controller, settings.watchdog_ms, lambda: self._now_ns
        )

    @property
    def base(self) -> SimulatedBase:
        """The simulated base."""
        return self._controller.base

    def process(self, command: VelocityCommand) -> None:
        """Let the base drive until the command's stamp, then send it."""
        # 1. Drive on until the stamp.
        since_s = (command.stamp_ns - self._now_ns) * 1e-9 if self._now_ns else 0.0
        self._now_ns = command.stamp_ns
        self.base.advance(min(since_s, LONGEST_ADVANCE_S))
        # 2. Send the command. After a pause the watchdog may have expired: then the controller expects a stop first.
        if since_s > self._rearm_s:
            self._motor.send(stop_command(command.stamp_ns))
        self._motor.send(command)
        # 3. Count it, and each stop of wheels that moved.
        self._sent += 1
        self._stops += self._moves and is_stop(command)
        self._moves = not is_stop(command)

    def finish(self) -> None:
        """Stop the wheels."""
        self._motor.close()

    def counts(self) -> dict[str, int]:
        """Return the commands that were answered, the errors, and how often moving wheels had to stop."""
        return {"commands": self._sent, "errors": self.base.errors, "stops": self._stops}
