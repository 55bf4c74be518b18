"""Simulated Roboteq dual-channel controller; sources as in drivers/motors/protocols/roboteq.py."""

from __future__ import annotations

import math
import re

from drivers.motors.protocols.differential_drive import DifferentialDrive
from drivers.motors.protocols.motor_protocol import TextFramer
from drivers.motors.protocols.roboteq import MAX_RPM, S_PER_MIN
from drivers.motors.simulated.simulated_base import SimulatedBase, SimulatedFirmware

_COMMAND = re.compile(rb"!S ([12]) (-?[0-9]{1,5})")


class SimulatedRoboteq(SimulatedFirmware):
    """One controller; by default it echoes, as a real one does."""

    def __init__(self, drive: DifferentialDrive | None = None) -> None:
        super().__init__(SimulatedBase(drive), TextFramer())
        self.base.watchdog_ms = 1000
        self._echo = True

    def _handle(self, frame: bytes) -> bytes:
        echo = frame + b"\r" if self._echo else b""
        return echo + (self._reply(frame) or self._reject(b"-")) + b"\r"

    def _reply(self, line: bytes) -> bytes | None:
        if command := _COMMAND.fullmatch(line):
            return self._drive(int(command[1]) - 1, int(command[2]))
        if setting := re.fullmatch(rb"\^(ECHOF|RWD) ([0-9]{1,5})", line):
            return self._set(setting[1], int(setting[2]))
        return self._query(line)

    def _drive(self, channel: int, rpm: int) -> bytes | None:
        if abs(rpm) > MAX_RPM:
            return None
        self.base.commands += 1
        self.base.command_channel(channel, rpm * self._mps_per_rpm())
        return b"+"

    def _set(self, name: bytes, value: int) -> bytes:
        if name == b"ECHOF":
            self._echo = value == 0
        else:
            self.base.watchdog_ms = value
        return b"+"

    def _query(self, line: bytes) -> bytes | None:
        speeds = b":".join(b"%d" % round(mps / self._mps_per_rpm()) for mps in self.base.channels_mps())
        return {
            b"?S": b"S=" + speeds,
            b"?V 2": b"V=%d" % round(self.base.battery_v * 10),
            b"?FF": b"FF=%d" % self.base.fault,
            b"~RWD": b"RWD=%d" % self.base.watchdog_ms,
            b"~MXMD": b"MXMD=0",
        }.get(line)

    def _mps_per_rpm(self) -> float:
        """Return the wheel speed of one rpm of the motor."""
        return math.tau * self.base.drive.wheel_radius_m / (S_PER_MIN * self.base.drive.gear)
