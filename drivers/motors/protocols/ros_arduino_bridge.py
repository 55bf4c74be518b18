"""Arduino boards with ROSArduinoBridge: commands <-> lines, no I/O.

Source: github.com/hbrobotics/ros_arduino_bridge, ROSArduinoBridge.ino, commands.h, diff_controller.h.

    "m left right"   encoder ticks for each turn of its speed loop (33 ms); answered by "OK"
    "e"              answered by "left right", the encoders' counts, signed 32 bits
    "r"              sets them to 0; answered by "OK"

Lines end in CR, answers in CR LF. The wheels stop 2000 ms after the last "m" (AUTO_STOP_INTERVAL), which is compiled
in: it can neither be set nor read. Speeds are whole ticks, so small ones are coarse.
"""

from __future__ import annotations

import math
import re

from drivers.errors import DriverError
from drivers.motor import MotorStatus, VelocityCommand
from drivers.motors.differential_drive import DifferentialDrive
from drivers.motors.motor_protocol import TextFramer, Transaction

AUTO_STOP_MS = 2000
FRAME_S = 0.033
MAX_TICKS = 32767  # an int of the board

_COUNTS = re.compile(rb"(-?[0-9]{1,10}) (-?[0-9]{1,10})")


class RosArduinoBridge:
    """One board: its left is channel 1."""

    baud = 57_600

    def __init__(self, drive: DifferentialDrive) -> None:
        self.bad_frames = 0
        self._drive = drive
        self._ticks_per_m = drive.turns_per_m * drive.ticks_per_turn
        self._last: tuple[float, tuple[int, int]] | None = None

    def framer(self) -> TextFramer:
        """Lines of text."""
        return TextFramer()

    def connect(self, watchdog_ms: int) -> Transaction[float]:
        """Hears whether this is such a board; DriverError where a shorter watchdog is asked for than it has."""
        if watchdog_ms < AUTO_STOP_MS:
            raise DriverError(
                f"watchdog of {watchdog_ms} ms asked, {AUTO_STOP_MS} ms is compiled into ROSArduinoBridge; "
                f"set motor.watchdog_ms = {AUTO_STOP_MS}"
            )
        self._last = None
        yield from self._told(b"r\re\r")
        return float(AUTO_STOP_MS)

    def drive(self, command: VelocityCommand, now_s: float) -> Transaction[MotorStatus]:
        """Both speeds and the question at once; the speed in the status is the mean since the last command."""
        per_mps = self._ticks_per_m * FRAME_S
        first, second = self._drive.channels(command, MAX_TICKS / per_mps)
        counts = yield from self._told(b"m %d %d\re\r" % (round(first * per_mps), round(second * per_mps)))
        velocity_mps, yaw_rate_radps = self._motion(counts, now_s)
        return MotorStatus(velocity_mps, math.nan, yaw_rate_radps, False, 0, math.nan)

    def _motion(self, counts: tuple[int, int], now_s: float) -> tuple[float, float]:
        """NaN where there was no count before."""
        last, self._last = self._last, (now_s, counts)
        if last is None or now_s <= last[0]:
            return math.nan, math.nan
        per_tick = 1 / (self._ticks_per_m * (now_s - last[0]))
        first, second = (_wrapped(new - old) * per_tick for new, old in zip(counts, last[1], strict=True))
        return self._drive.motion(first, second)

    def _told(self, lines: bytes) -> Transaction[tuple[int, int]]:
        """Writes an order and the question, and gives the counts once the order is confirmed."""
        confirmed = False
        frame = yield lines
        while True:
            counts = _COUNTS.fullmatch(frame)
            if counts and confirmed:
                return int(counts[1]), int(counts[2])
            self.bad_frames += counts is None and frame != b"OK"
            confirmed = confirmed or frame == b"OK"
            frame = yield b""


def _wrapped(ticks: int) -> int:
    """A difference of two counts of 32 bits."""
    return (ticks + (1 << 31)) % (1 << 32) - (1 << 31)
