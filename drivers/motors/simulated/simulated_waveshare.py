"""Simulated Waveshare UGV board; sources as in drivers/motors/protocols/waveshare_json.py."""

from __future__ import annotations

import json
import math
from typing import Any

from drivers.motors.protocols.differential_drive import DifferentialDrive
from drivers.motors.protocols.motor_protocol import TextFramer
from drivers.motors.protocols.waveshare_json import (
    BASE_INFO,
    ECHO,
    FEEDBACK,
    HEARTBEAT,
    INTERVAL,
    MAX_LINE,
    MAX_WHEEL_MPS,
    SPEED,
    STREAM,
)
from drivers.motors.simulated.simulated_base import SimulatedBase, reply_to

_SETTINGS = (STREAM, HEARTBEAT, INTERVAL, ECHO)
_HEARTBEAT_MS = 3000  # default of the firmware


class SimulatedWaveshare:
    """One board; by default it sends its feedback with every reply, and echoes."""

    def __init__(self, drive: DifferentialDrive | None = None) -> None:
        self.base = SimulatedBase(drive)
        self.base.watchdog_ms = _HEARTBEAT_MS
        self._framer = TextFramer(MAX_LINE)
        self._settings = {STREAM: 1, INTERVAL: 0, ECHO: 1}

    def feed(self, data: bytes) -> bytes:
        """Return the replies to all lines that end in data."""
        return reply_to(self.base, self._framer, self._handle, data)

    def _handle(self, line: bytes) -> bytes:
        echo = line + b"\r\n" if self._settings[ECHO] else b""
        try:
            command = json.loads(line)
            kind = command["T"]
        except (ValueError, TypeError, KeyError, RecursionError):
            kind, command = None, {}
        if kind == SPEED:
            self._drive(command)
        elif kind in _SETTINGS:
            self._set(kind, command.get("cmd"))
        elif kind != FEEDBACK:
            self.base.errors += 1
        return echo + self._feedback() if kind == FEEDBACK or self._settings[STREAM] else echo

    def _drive(self, command: dict[str, Any]) -> None:
        speeds: list[Any] = [command.get("L"), command.get("R")]
        if len(command) != 3 or not all(isinstance(mps, float) and abs(mps) <= MAX_WHEEL_MPS for mps in speeds):
            self.base.errors += 1
            return
        self.base.commands += 1
        self.base.command_channels(speeds[0], speeds[1])

    def _set(self, kind: int, value: object) -> None:
        if not isinstance(value, int) or value < 0:
            self.base.errors += 1
        elif kind == HEARTBEAT:
            self.base.watchdog_ms = value
        else:
            self._settings[kind] = value

    def _feedback(self) -> bytes:
        first, second = self.base.channels_mps()
        message = {"T": BASE_INFO, "L": first, "R": second, "r": 0.0, "p": 0.0, "y": math.degrees(self.base.pose[2]),
                   "temp": 31.5, "v": self.base.battery_v}  # fmt: skip
        return json.dumps(message).encode() + b"\r\n"
