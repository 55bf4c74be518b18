"""Arduino boards with ROSArduinoBridge: commands <-> lines, no I/O.

Source: github.com/hbrobotics/ros_arduino_bridge, ROSArduinoBridge.ino, commands.h, diff_controller.h.

    "m left right"   encoder ticks per period of its speed loop (33 ms); reply "OK"
    "e"              reply "left right", the encoders' counts, signed 32 bits
    "r"              sets them to 0; reply "OK"

Lines end in CR, replies in CR LF. Speeds are whole ticks, so low speeds are coarse.

The wheels stop 2000 ms after the last "m". This time, AUTO_STOP_INTERVAL, is compiled in: it can neither be set nor
read. So a robot at 0.5 m/s drives up to 1 m after this program or the cable fails, and motor.watchdog_ms has to admit
it: a shorter value is refused. A board with a shorter AUTO_STOP_INTERVAL stops earlier, but is taken for 2000 ms.
"""

from __future__ import annotations

import math
import re

from drivers.errors import DriverError
from drivers.motor import MotorStatus, VelocityCommand
from drivers.motors.protocols.differential_drive import DifferentialDrive
from drivers.motors.protocols.motor_protocol import TextFramer, Transaction

AUTO_STOP_MS = 2000  # ROSArduinoBridge.ino: AUTO_STOP_INTERVAL
LOOP_S = 0.033  # ROSArduinoBridge.ino: PID_RATE 30 Hz, PID_INTERVAL = 1000 / 30 ms in whole ms
MAX_TICKS = 32767  # int of the board: 16 bits

_COUNTS = re.compile(rb"(-?[0-9]{1,10}) (-?[0-9]{1,10})")


class RosArduinoBridge:
    """One board: its left motor is channel 1."""

    baud = 57_600

    def __init__(self, drive: DifferentialDrive) -> None:
        self.bad_frames = 0
        self._drive = drive
        self._ticks_per_m = drive.turns_per_m * drive.ticks_per_turn
        self._last: tuple[float, tuple[int, int]] | None = None  # time [s], counts of both encoders

    def framer(self) -> TextFramer:
        """Return a framer of lines."""
        return TextFramer()

    def connect(self, watchdog_ms: int) -> Transaction[float]:
        """Verify that the board replies, and return its watchdog time [ms].

        Raises DriverError where a shorter time is requested.
        """
        if watchdog_ms < AUTO_STOP_MS:
            raise DriverError(
                f"watchdog of {watchdog_ms} ms requested, {AUTO_STOP_MS} ms is compiled into ROSArduinoBridge: the "
                f"wheels turn for so long after the last command; if the robot may, set motor.watchdog_ms = "
                f"{AUTO_STOP_MS}"
            )
        self._last = None
        yield from self._counts_after(b"r\re\r")
        return float(AUTO_STOP_MS)

    def drive(self, command: VelocityCommand, now_s: float) -> Transaction[MotorStatus]:
        """Send both speeds and request the counts; the velocity in the status is the mean since the last command."""
        ticks_per_mps = self._ticks_per_m * LOOP_S
        first_mps, second_mps = self._drive.channels(command, MAX_TICKS / ticks_per_mps)
        ticks = round(first_mps * ticks_per_mps), round(second_mps * ticks_per_mps)
        counts = yield from self._counts_after(b"m %d %d\re\r" % ticks)
        velocity_mps, yaw_rate_radps = self._motion(counts, now_s)
        return MotorStatus(velocity_mps, math.nan, yaw_rate_radps, False, 0, math.nan)

    def _motion(self, counts: tuple[int, int], now_s: float) -> tuple[float, float]:
        """Return velocity and yaw rate since the last counts, NaN without these."""
        last, self._last = self._last, (now_s, counts)
        if last is None or now_s <= last[0]:
            return math.nan, math.nan
        last_s, last_counts = last
        tick_mps = 1 / (self._ticks_per_m * (now_s - last_s))
        first, second = (_wrapped(new - old) * tick_mps for new, old in zip(counts, last_counts, strict=True))
        return self._drive.motion(first, second)

    def _counts_after(self, lines: bytes) -> Transaction[tuple[int, int]]:
        """Write a command and the request for the counts; return them once the command is confirmed."""
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
    """Return the difference of two signed 32-bit counts, of which one may have overflowed."""
    return (ticks + (1 << 31)) % (1 << 32) - (1 << 31)
