"""Simulated firmware of a motor controller with the line protocol."""

from __future__ import annotations

import math

from drivers.motor import MotorStatus, VelocityCommand, is_stop
from drivers.motors.protocols.differential_drive import DifferentialDrive
from drivers.motors.protocols.line_protocol import (
    SEQ_COUNT,
    ProtocolError,
    command_of,
    decode,
    encode,
    status_line,
)
from drivers.motors.protocols.motor_protocol import TextFramer
from drivers.motors.simulated.simulated_base import SimulatedBase, SimulatedFirmware


class SimulatedLine(SimulatedFirmware):
    """One controller; heading_input: steer to the commanded heading, else follow the commanded yaw rate."""

    def __init__(self, drive: DifferentialDrive | None = None, *, heading_input: bool = True) -> None:
        super().__init__(SimulatedBase(drive), TextFramer())
        self._heading_input = heading_input
        self._zero_rad = 0.0  # heading in the world at which the controller's heading is 0
        self._next_seq: int | None = None

    def handle(self, frame: bytes) -> bytes:
        """Return the reply to a frame, empty without one."""
        try:
            kind, numbers = decode(frame)
        except ProtocolError:
            return self._reject(b"")
        if kind == "V":
            return self._drive(numbers[0], command_of(numbers))
        return self._connect(numbers[0]) if kind == "W" else self._reject(b"")

    def _drive(self, seq: int, command: VelocityCommand) -> bytes:
        self.base.errors += self._next_seq not in (None, seq)
        self._next_seq = (seq + 1) % SEQ_COUNT
        self.base.commands += 1
        reply = status_line(seq, self._status())
        steers = self._heading_input and not is_stop(command)
        self.base.goal_heading_rad = command.heading_rad + self._zero_rad if steers else None
        self.base.command(command.velocity_mps, command.yaw_rate_radps)
        return reply

    def _connect(self, watchdog_ms: int) -> bytes:
        """Start a connection: stop, set the present heading to 0, accept any seq as the first one."""
        self.base.watchdog_ms = watchdog_ms
        self._next_seq = None
        self._zero_rad = self.base.pose[2]
        self.base.command(0.0, 0.0)
        return encode("A", watchdog_ms)

    def _status(self) -> MotorStatus:
        base = self.base
        heading_rad = math.remainder(base.pose[2] - self._zero_rad, math.tau)
        state = base.watchdog_expired, base.fault, base.battery_v, base.bumper, base.cliff
        return MotorStatus(base.velocity_mps, heading_rad, base.yaw_rate_radps, *state)
