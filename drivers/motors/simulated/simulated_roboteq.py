"""Simulated Roboteq dual-channel controller; sources as in drivers/motors/protocols/roboteq.py."""

from __future__ import annotations

import math
import re

from drivers.motors.protocols.differential_drive import DifferentialDrive
from drivers.motors.protocols.motor_protocol import TextFramer
from drivers.motors.protocols.roboteq import FULL, MIXED, RPM, S_PER_MIN
from drivers.motors.simulated.simulated_base import SimulatedBase, reply_to

_COMMAND = re.compile(rb"!([SG]) ([12]) (-?[0-9]{1,5})")
_MAX_VALUE = {b"S": 65535, b"G": 1000}  # rpm; full power


class SimulatedRoboteq:
    """One controller; by default it echoes, as a real one does."""

    def __init__(self, drive: DifferentialDrive | None = None, mode: str = RPM) -> None:
        self.base = SimulatedBase(drive)
        self.base.watchdog_ms = 1000
        self._mode = mode
        self._framer = TextFramer()
        self._echo = True
        self._mixed = [0.0, 0.0]  # throttle and steering

    def feed(self, data: bytes) -> bytes:
        """Return the replies to all lines that end in data."""
        return reply_to(self.base, self._framer, self._handle, data)

    def _handle(self, line: bytes) -> bytes:
        echo = line + b"\r" if self._echo else b""
        return echo + (self._reply(line) or self._rejection()) + b"\r"

    def _reply(self, line: bytes) -> bytes | None:
        if command := _COMMAND.fullmatch(line):
            return self._drive(command[1], int(command[2]) - 1, int(command[3]))
        if setting := re.fullmatch(rb"\^(ECHOF|RWD) ([0-9]{1,5})", line):
            return self._set(setting[1], int(setting[2]))
        return self._query(line)

    def _rejection(self) -> bytes:
        self.base.errors += 1
        return b"-"

    def _drive(self, kind: bytes, channel: int, value: int) -> bytes | None:
        if abs(value) > _MAX_VALUE[kind] or (kind == b"S") != (self._mode == RPM):
            return None
        self.base.commands += 1
        if self._mode == MIXED:
            return self._mix(channel, value)
        self.base.command_channel(channel, value * self._unit_mps())
        return b"+"

    def _mix(self, channel: int, value: int) -> bytes:
        """Set throttle or steering; both motors follow the steering, which comes last."""
        self._mixed[channel] = value
        throttle, steering = self._mixed
        if channel == 1:
            unit_mps = self._unit_mps()
            self.base.command_channels((throttle + steering) * unit_mps, (throttle - steering) * unit_mps)
        return b"+"

    def _set(self, name: bytes, value: int) -> bytes:
        if name == b"ECHOF":
            self._echo = value == 0
        else:
            self.base.watchdog_ms = value
        return b"+"

    def _query(self, line: bytes) -> bytes | None:
        speeds = b":".join(b"%d" % round(mps / self._unit_mps()) for mps in self.base.channels_mps())
        return {
            b"?S": b"S=" + speeds,
            b"?M": b"M=" + speeds,
            b"?V 2": b"V=%d" % round(self.base.battery_v * 10),
            b"?FF": b"FF=%d" % self.base.fault,
            b"~RWD": b"RWD=%d" % self.base.watchdog_ms,
            b"~MXMD": b"MXMD=%d" % (self._mode == MIXED),
        }.get(line)

    def _unit_mps(self) -> float:
        """Return the wheel speed of one rpm of the motor, or of a thousandth of full power."""
        if self._mode == RPM:
            return math.tau * self.base.drive.wheel_radius_m / (S_PER_MIN * self.base.drive.gear)
        return self.base.drive.max_wheel_mps / FULL
