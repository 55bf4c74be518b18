"""The twin of a Waveshare UGV board; the source is named in drivers/motors/protocols/waveshare_json.py."""

from __future__ import annotations

import json
import math
from typing import Any

from drivers.motors.differential_drive import DifferentialDrive
from drivers.motors.motor_protocol import TextFramer
from drivers.motors.simulated.simulated_base import SimulatedBase, reply_to

_TOP_MPS = 2.0
_SETTINGS = (131, 136, 142, 143)


class SimulatedWaveshare:
    """Streams its feedback with every answer until it is told not to."""

    def __init__(self, drive: DifferentialDrive | None = None) -> None:
        self.base = SimulatedBase(drive)
        self.base.watchdog_ms = 3000
        self._framer = TextFramer(1024)
        self._settings = {131: 1, 142: 0, 143: 1}

    def feed(self, data: bytes) -> bytes:
        """The answers to all lines that end in data."""
        return reply_to(self.base, self._framer, self._handle, data)

    def _handle(self, line: bytes) -> bytes:
        answer = line + b"\r\n" if self._settings[143] else b""
        try:
            command = json.loads(line)
            kind = command["T"]
        except (ValueError, TypeError, KeyError, RecursionError):
            kind, command = None, {}
        if kind == 1:
            self._drive(command)
        elif kind in _SETTINGS:
            self._set(kind, command.get("cmd"))
        elif kind != 130:
            self.base.errors += 1
        return answer + self._feedback() if kind == 130 or self._settings[131] else answer

    def _drive(self, command: dict[str, Any]) -> None:
        speeds: list[Any] = [command.get("L"), command.get("R")]
        if len(command) != 3 or not all(isinstance(mps, float) and abs(mps) <= _TOP_MPS for mps in speeds):
            self.base.errors += 1
            return
        self.base.commands += 1
        self.base.command_channels(speeds[0], speeds[1])

    def _set(self, kind: int, value: object) -> None:
        if not isinstance(value, int) or value < 0:
            self.base.errors += 1
        elif kind == 136:
            self.base.watchdog_ms = value
        else:
            self._settings[kind] = value

    def _feedback(self) -> bytes:
        first, second = self.base.channels_mps()
        said = {"T": 1001, "L": first, "R": second, "r": 0.0, "p": 0.0, "y": math.degrees(self.base.pose[2]),
                "temp": 31.5, "v": self.base.battery_v}  # fmt: skip
        return json.dumps(said).encode() + b"\r\n"
