"""ODrive v3 with two axes (firmware 0.5), ASCII protocol: commands <-> lines, no I/O.

Source: ODrive documentation, "ASCII Protocol"; firmware 0.5.x, communication/ascii_protocol.cpp and MotorControl/axis.

    "v axis turns_per_s"     velocity; feeds the axis' watchdog, as "u axis" does
    "f axis"                 answered by "position velocity", turns and turns/s
    "w property value"       no answer
    "r property"             answered by the value

Each line ends in LF. With "*n" at its end, n the exclusive or of all bytes before, a damaged line is dropped, and the
answer carries one as well: here every line does. An axis whose watchdog has expired is disarmed: the error flag 0x800
stays, and nothing moves until it is cleared and closed-loop control is requested, which is done with the zero that
comes first. Other errors are never cleared here: they are the fault that is reported.
Answers do not name their question, so they are taken in order and only where all came and fit.
"""

from __future__ import annotations

import functools
import math
import operator
import re
from collections.abc import Sequence

from drivers.errors import DriverError
from drivers.motor import MotorStatus, VelocityCommand, is_stop
from drivers.motors.differential_drive import DifferentialDrive
from drivers.motors.motor_protocol import TextFramer, Transaction, require_watchdog

AXES = (0, 1)
WATCHDOG_EXPIRED = 0x800
CLOSED_LOOP = 8
VELOCITY_CONTROL = 2

_SEALED = re.compile(rb"([^*]*)\*([0-9]{1,3})")
_WORDS = {b"true": 1.0, b"false": 0.0}


def sealed(line: str) -> bytes:
    """The line with its checksum and end."""
    return b"%b*%d\n" % (line.encode(), _xor(line.encode()))


class ODriveAscii:
    """One two-axis board: axis 0 is channel 1."""

    baud = 115_200

    def __init__(self, drive: DifferentialDrive) -> None:
        self.bad_frames = 0
        self._drive = drive
        self._disarmed = True

    def framer(self) -> TextFramer:
        """Lines of text."""
        return TextFramer()

    def connect(self, watchdog_ms: int) -> Transaction[float]:
        """Sets both watchdogs and reads them back; DriverError where an axis has an error that is not its watchdog's.

        The axes are armed by the first stop.
        """
        self._disarmed = True
        lines = [line for axis in AXES for line in _setup(axis, watchdog_ms / 1000)]
        asked = ("config.enable_watchdog", "config.watchdog_timeout", "error")
        answers = yield from self._asked(lines, [f"r axis{axis}.{name}" for axis in AXES for name in asked])
        for enabled, timeout, error in zip(*[iter(answers)] * len(asked), strict=True):
            if int(error[0]) & ~WATCHDOG_EXPIRED:
                raise DriverError(f"an axis has error 0x{int(error[0]):x}; see `odrivetool`, dump_errors(odrv0, True)")
            require_watchdog(watchdog_ms, 1000 * timeout[0] if enabled[0] else 0.0)
        return float(watchdog_ms)

    def drive(self, command: VelocityCommand, now_s: float) -> Transaction[MotorStatus]:
        """Both velocities and the questions at once; a stop arms axes that are not."""
        arming = self._disarmed and is_stop(command)
        speeds = self._drive.channels(command)
        lines = [f"v {axis} {mps * self._drive.turns_per_m:.5f}" for axis, mps in zip(AXES, speeds, strict=True)]
        if arming:
            lines += [line for axis in AXES for line in _arming(axis)]
        asked = ["f 0", "f 1", "r axis0.error", "r axis1.error", "r vbus_voltage"]
        first, second, *errors, battery = yield from self._asked(lines, asked)
        flags = int(errors[0][0]) | int(errors[1][0])
        self._disarmed = bool(flags & WATCHDOG_EXPIRED) or (self._disarmed and not arming)
        motion = self._drive.motion(first[-1] / self._drive.turns_per_m, second[-1] / self._drive.turns_per_m)
        return MotorStatus(motion[0], math.nan, motion[1], self._disarmed, flags & ~WATCHDOG_EXPIRED, battery[0])

    def _asked(self, lines: Sequence[str], questions: Sequence[str]) -> Transaction[list[list[float]]]:
        """Writes lines and questions and gives the numbers of each answer; "f" has two, "r" one."""
        answers: list[list[float]] = []
        frame = yield b"".join(map(sealed, [*lines, *questions]))
        while True:
            numbers = self._numbers(frame)
            if numbers and len(numbers) == (2 if questions[len(answers)][0] == "f" else 1):
                answers.append(numbers)
            else:
                self.bad_frames += 1
                answers.clear()  # one is missing, so nobody knows which is which: silence is asked again
            if len(answers) == len(questions):
                return answers
            frame = yield b""

    def _numbers(self, frame: bytes) -> list[float] | None:
        match = _SEALED.fullmatch(frame)
        if match is None or int(match[2]) != _xor(match[1]):
            return None
        if match[1].startswith((b"invalid", b"unknown", b"not")):
            said = match[1].decode("ascii", "replace")
            raise DriverError(f"it answered {said!r}; a board with two axes and firmware 0.5 is needed")
        numbers = [_number(word) for word in match[1].split()[:3]]
        return numbers if all(map(math.isfinite, numbers)) else None


def _setup(axis: int, timeout_s: float) -> list[str]:
    """The timeout is set and fed before it counts."""
    config = f"w axis{axis}.config"
    return [f"{config}.enable_watchdog 0", f"{config}.watchdog_timeout {timeout_s:g}", f"u {axis}",
            f"{config}.enable_watchdog 1"]  # fmt: skip


def _arming(axis: int) -> list[str]:
    return [f"w axis{axis}.controller.config.control_mode {VELOCITY_CONTROL}", f"w axis{axis}.error 0", f"u {axis}",
            f"w axis{axis}.requested_state {CLOSED_LOOP}"]  # fmt: skip


def _number(word: bytes) -> float:
    try:
        return float(word)
    except ValueError:
        return _WORDS.get(word.lower(), math.nan)


def _xor(data: bytes) -> int:
    return functools.reduce(operator.xor, data, 0)
