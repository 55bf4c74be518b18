"""Simulated Arduino with ROSArduinoBridge; sources as in drivers/motors/protocols/ros_arduino_bridge.py."""

from __future__ import annotations

import math
import re

from drivers.motors.protocols.differential_drive import DifferentialDrive
from drivers.motors.protocols.motor_protocol import TextFramer
from drivers.motors.simulated.simulated_base import SimulatedBase, reply_to

# AUTO_STOP_INTERVAL and PID_INTERVAL of the firmware, written here again: a wrong value in the protocol must show.
_AUTO_STOP_MS, _LOOP_S = 2000, 0.033
_MAX_LINE = 40  # bytes; the longest command, "m -32767 -32767", is shorter
_MAX_TICKS = 32767  # an int of the board has 16 bits
_FIRST_COUNT = 2**31 - 100  # a hundred ticks before the 32 bits overflow, so that short drives cross it


class SimulatedArduino:
    """A simulated board. Its counts of ticks start at _FIRST_COUNT, so that they overflow soon."""

    def __init__(self, drive: DifferentialDrive | None = None) -> None:
        self.base = SimulatedBase(drive)
        self.base.watchdog_ms = _AUTO_STOP_MS
        self._framer = TextFramer(_MAX_LINE)

    def feed(self, data: bytes) -> bytes:
        """Return the replies to all lines that end in data."""
        return reply_to(self.base, self._framer, self._handle, data)

    def _handle(self, line: bytes) -> bytes:
        return self._reply(line) + b"\r\n"

    def _reply(self, line: bytes) -> bytes:
        if command := re.fullmatch(rb"m (-?[0-9]{1,5}) (-?[0-9]{1,5})", line):
            return self._drive(int(command[1]), int(command[2]))
        if line == b"e":
            return b"%d %d" % self._counts()
        if line == b"r":
            return b"OK"  # the counts are not reset: the host uses only their differences
        self.base.errors += 1
        return b"Invalid Command"

    def _drive(self, first: int, second: int) -> bytes:
        self.base.errors += max(abs(first), abs(second)) > _MAX_TICKS
        self.base.commands += 1
        tick_mps = 1 / (self._ticks_per_m() * _LOOP_S)
        self.base.command_channels(first * tick_mps, second * tick_mps)
        return b"OK"

    def _counts(self) -> tuple[int, int]:
        first_m, second_m = self.base.channels_m()
        ticks_per_m = self._ticks_per_m()
        return (_signed(round(first_m * ticks_per_m) + _FIRST_COUNT),
                _signed(round(second_m * ticks_per_m) + _FIRST_COUNT))  # fmt: skip

    def _ticks_per_m(self) -> float:
        drive = self.base.drive
        return drive.ticks_per_turn * drive.gear / (math.tau * drive.wheel_radius_m)


def _signed(count: int) -> int:
    """Return the count as a signed number of 32 bits."""
    return (count + 2**31) % 2**32 - 2**31
