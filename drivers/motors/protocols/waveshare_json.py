"""Waveshare UGV and Wave Rover boards: commands <-> lines of JSON, no I/O.

Source: Waveshare's firmware (github.com/waveshareteam/ugv_base_ros, ROS_Driver): json_cmd.h, uart_ctrl.h,
movtion_module.h, ugv_advance.h.

    {"T":1,"L":l,"R":r}   wheel speeds, m/s, within -2 .. 2: anything beyond is dropped whole
    {"T":136,"cmd":ms}    heartbeat: the wheels stop after so long without a speed command
    {"T":130}             answered by {"T":1001,"L":l,"R":r,"v":volt, ...}; "v" is hundredths in some versions
    {"T":131,"cmd":0}     no stream of feedback; {"T":142,"cmd":0} feedback at any rate; {"T":143,"cmd":0} no echo

{"T":13,"X":v,"Z":w} takes a speed and a yaw rate, but the firmware feeds its heartbeat on T 1 and T 11 only, and once
the heartbeat has fired, T 13 drives on for ever: it is not used here. The heartbeat's time cannot be read back.
Lines end in LF.
"""

from __future__ import annotations

import json
import math

from drivers.motor import MotorStatus, VelocityCommand
from drivers.motors.differential_drive import DifferentialDrive
from drivers.motors.motor_protocol import TextFramer, Transaction, request

SPEED, FEEDBACK, STREAM, HEARTBEAT, INTERVAL, ECHO, BASE_INFO = 1, 130, 131, 136, 142, 143, 1001
MAX_WHEEL_MPS = 2.0
LONGEST_LINE = 1024
MOST_VOLT = 100.0


def line(kind: int, **values: float) -> bytes:
    """The line of a command."""
    return json.dumps({"T": kind, **values}, separators=(",", ":")).encode() + b"\n"


class WaveshareJson:
    """One board: L is channel 1."""

    baud = 115_200

    def __init__(self, drive: DifferentialDrive) -> None:
        self.bad_frames = 0
        self._drive = drive

    def framer(self) -> TextFramer:
        """Lines of text."""
        return TextFramer(LONGEST_LINE)

    def connect(self, watchdog_ms: int) -> Transaction[float]:
        """Sets the heartbeat, silences what nobody asked for, and hears whether this is such a board at all."""
        lines = [line(kind, cmd=0) for kind in (ECHO, STREAM, INTERVAL)]
        yield from request(b"".join([*lines, line(HEARTBEAT, cmd=watchdog_ms), line(FEEDBACK)]), self._feedback)
        return float(watchdog_ms)

    def drive(self, command: VelocityCommand, now_s: float) -> Transaction[MotorStatus]:
        """The speeds and the question at once."""
        first, second = self._drive.channels(command, MAX_WHEEL_MPS)
        order = line(SPEED, L=round(first, 4), R=round(second, 4)) + line(FEEDBACK)
        first, second, battery_v = yield from request(order, self._feedback)
        velocity_mps, yaw_rate_radps = self._drive.motion(first, second)
        return MotorStatus(velocity_mps, math.nan, yaw_rate_radps, False, 0, battery_v)

    def _feedback(self, frame: bytes) -> tuple[float, float, float] | None:
        """Speeds of the channels [m/s] and the battery [V, NaN if not said]; None of any other line."""
        try:
            said = json.loads(frame)
            if said["T"] != BASE_INFO:
                return None  # an echo, or news of something else
            first, second, battery_v = float(said["L"]), float(said["R"]), float(said.get("v", math.nan))
        except (ValueError, TypeError, KeyError, AttributeError, OverflowError, RecursionError):
            self.bad_frames += 1
            return None
        if not (math.isfinite(first) and math.isfinite(second)):
            return None
        return first, second, battery_v / 100 if battery_v > MOST_VOLT else battery_v
