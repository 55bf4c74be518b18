"""Waveshare UGV and Wave Rover boards: commands <-> lines of JSON, no I/O.

Source: Waveshare's firmware (github.com/waveshareteam/ugv_base_ros, ROS_Driver): json_cmd.h, uart_ctrl.h,
movtion_module.h, ugv_advance.h.

    {"T":1,"L":l,"R":r}   wheel speeds, m/s, within -2 .. 2: a command out of this range is ignored
    {"T":136,"cmd":ms}    heartbeat: time without a speed command after which the wheels stop
    {"T":130}             reply {"T":1001,"L":l,"R":r,"v":volt, ...}; "v" is hundredths in some versions
    {"T":131,"cmd":0}     no stream of feedback; {"T":142,"cmd":0} feedback at any rate; {"T":143,"cmd":0} no echo

{"T":13,"X":v,"Z":w} takes a velocity and a yaw rate, but only T 1 and T 11 feed the firmware's heartbeat, and once it
has fired, T 13 drives without a time limit: it is not used here. The heartbeat's time cannot be read back.
Lines end in LF.
"""

from __future__ import annotations

import json
import math

from drivers.motor import MotorStatus, VelocityCommand
from drivers.motors.protocols.differential_drive import DifferentialDrive
from drivers.motors.protocols.motor_protocol import TextFramer, Transaction, request

SPEED, FEEDBACK, STREAM, HEARTBEAT, INTERVAL, ECHO, BASE_INFO = 1, 130, 131, 136, 142, 143, 1001  # json_cmd.h
MAX_WHEEL_MPS = 2.0  # movtion_module.h
MAX_LINE = 1024  # bytes
MAX_BATTERY_V = 100.0  # a higher number is in hundredths of a volt
SPEED_DIGITS = 4


def line(kind: int, **values: float) -> bytes:
    """Return the line of a command."""
    return json.dumps({"T": kind, **values}, separators=(",", ":")).encode() + b"\n"


class WaveshareJson:
    """One board: L is channel 1."""

    baud = 115_200

    def __init__(self, drive: DifferentialDrive) -> None:
        self.bad_frames = 0
        self._drive = drive

    def framer(self) -> TextFramer:
        """Return a framer of lines."""
        return TextFramer(MAX_LINE)

    def connect(self, watchdog_ms: int) -> Transaction[float]:
        """Set the heartbeat, switch off unrequested messages, verify that the board replies; return the time [ms]."""
        lines = [line(kind, cmd=0) for kind in (ECHO, STREAM, INTERVAL)]
        yield from request(b"".join([*lines, line(HEARTBEAT, cmd=watchdog_ms), line(FEEDBACK)]), self._feedback)
        return float(watchdog_ms)

    def drive(self, command: VelocityCommand, now_s: float) -> Transaction[MotorStatus]:
        """Send the speeds and request the status at once."""
        left, right = self._drive.channels(command, MAX_WHEEL_MPS)
        lines = line(SPEED, L=round(left, SPEED_DIGITS), R=round(right, SPEED_DIGITS)) + line(FEEDBACK)
        first_mps, second_mps, battery_v = yield from request(lines, self._feedback)
        velocity_mps, yaw_rate_radps = self._drive.motion(first_mps, second_mps)
        return MotorStatus(velocity_mps, math.nan, yaw_rate_radps, False, 0, battery_v)

    def _feedback(self, frame: bytes) -> tuple[float, float, float] | None:
        """Return the speeds of the channels [m/s] and the battery [V, NaN if missing]; None of any other line."""
        try:
            message = json.loads(frame)
            if message["T"] != BASE_INFO:
                return None  # an echo, or a message of another kind
            first_mps, second_mps = float(message["L"]), float(message["R"])
            battery_v = float(message.get("v", math.nan))
        except (ValueError, TypeError, KeyError, AttributeError, OverflowError, RecursionError):
            self.bad_frames += 1
            return None
        if not (math.isfinite(first_mps) and math.isfinite(second_mps)):
            return None
        if battery_v > MAX_BATTERY_V:
            battery_v /= 100
        return first_mps, second_mps, battery_v
