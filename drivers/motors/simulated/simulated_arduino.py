"""Simulated Arduino with ROSArduinoBridge; for the source see drivers/motors/protocols/ros_arduino_bridge.py."""

from __future__ import annotations

import math
import re

from drivers.motors.differential_drive import DifferentialDrive
from drivers.motors.motor_protocol import TextFramer
from drivers.motors.simulated.simulated_base import SimulatedBase, reply_to

_AUTO_STOP_MS, _LOOP_S = 2000, 0.033


class SimulatedArduino:
    """Its counts start near the end of their 32 bits, so that they run over."""

    def __init__(self, drive: DifferentialDrive | None = None) -> None:
        self.base = SimulatedBase(drive)
        self.base.watchdog_ms = _AUTO_STOP_MS
        self._framer = TextFramer(40)
        self._zero = [-(2**31 - 100), -(2**31 - 100)]

    def feed(self, data: bytes) -> bytes:
        """The answers to all lines that end in data."""
        return reply_to(self.base, self._framer, self._handle, data)

    def _handle(self, line: bytes) -> bytes:
        return self._answer(line) + b"\r\n"

    def _answer(self, line: bytes) -> bytes:
        if order := re.fullmatch(rb"m (-?[0-9]{1,5}) (-?[0-9]{1,5})", line):
            return self._drive(int(order[1]), int(order[2]))
        if line == b"e":
            return b"%d %d" % self._counts()
        if line == b"r":
            return b"OK"  # the counts stay where they are: a host that counts differences does not mind
        self.base.errors += 1
        return b"Invalid Command"

    def _drive(self, first: int, second: int) -> bytes:
        self.base.errors += max(abs(first), abs(second)) > 32767
        self.base.commands += 1
        per_tick = 1 / (self._ticks_per_m() * _LOOP_S)
        self.base.command_channels(first * per_tick, second * per_tick)
        return b"OK"

    def _counts(self) -> tuple[int, int]:
        first, second = (
            _signed(round(way_m * self._ticks_per_m()) - zero)
            for way_m, zero in zip(self.base.channels_m(), self._zero, strict=True)
        )
        return first, second

    def _ticks_per_m(self) -> float:
        drive = self.base.drive
        return drive.ticks_per_turn * drive.gear / (math.tau * drive.wheel_radius_m)


def _signed(count: int) -> int:
    return (count + 2**31) % 2**32 - 2**31
