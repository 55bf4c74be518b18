"""ODrive v3 with two axes (firmware 0.5), ASCII protocol: commands <-> lines, no I/O.

Source: ODrive documentation, "ASCII Protocol"; firmware 0.5.x, communication/ascii_protocol.cpp and MotorControl/axis.

    "v axis turns_per_s"     velocity; feeds the axis' watchdog, as "u axis" does
    "f axis"                 reply "position velocity", turns and turns/s
    "w property value"       no reply
    "r property"             reply: the value

Each line ends in LF. A line may carry a checksum: "*n" at its end, n the exclusive or of all bytes before. ODrive drops
a damaged line that has one, and its reply carries one as well; this driver always sends it. An axis whose watchdog has
expired is disarmed: the error flag 0x800 stays, and nothing moves until it is cleared and closed-loop control is
requested, which is done together with the stop that the driver sends first. Other errors are never cleared: they are
reported as the fault. Replies do not name their request, so they are assigned in order, and only if all arrive and fit.
"""

from __future__ import annotations

import functools
import math
import operator
import re
from collections.abc import Sequence

from drivers.errors import DriverError
from drivers.motor import MotorStatus, VelocityCommand, is_stop
from drivers.motors.protocols.motor_protocol import DifferentialDrive, TextFramer, Transaction, require_watchdog

WATCHDOG_EXPIRED = 0x800  # AXIS_ERROR_WATCHDOG_TIMER_EXPIRED (firmware 0.5, odrive-interface.yaml)
CLOSED_LOOP = 8  # AXIS_STATE_CLOSED_LOOP_CONTROL
VELOCITY_CONTROL = 2  # CONTROL_MODE_VELOCITY_CONTROL

_CHECKED_LINE = re.compile(rb"([^*]*)\*([0-9]{1,3})")


def with_checksum(line: str) -> bytes:
    """Return the line with its checksum and end."""
    return b"%b*%d\n" % (line.encode(), _xor(line.encode()))


class ODriveAscii:
    """One two-axis board: axis 0 is channel 1."""

    baud = 115_200
    framer = TextFramer

    def __init__(self, drive: DifferentialDrive) -> None:
        self._drive = drive
        self._disarmed = True

    def connect(self, watchdog_ms: int) -> Transaction[float]:
        """Set both watchdogs and read them back; return the time in force [ms]. The first stop arms the axes.

        Raises DriverError where another time is in force, or an axis has an error other than its watchdog's.
        """
        self._disarmed = True
        lines = list[str]()
        for axis in (0, 1):  # The watchdog's timeout is set, and fed, before it is enabled.
            config = f"w axis{axis}.config"
            lines += [f"{config}.enable_watchdog 0", f"{config}.watchdog_timeout {watchdog_ms / 1000:g}"]
            lines += [f"u {axis}", f"{config}.enable_watchdog 1"]
        properties = ("config.enable_watchdog", "config.watchdog_timeout", "error")
        replies = yield from self._query(lines, [f"r axis{axis}.{name}" for axis in (0, 1) for name in properties])
        for enabled, timeout, error in zip(*[iter(replies)] * len(properties), strict=True):
            if int(error[0]) & ~WATCHDOG_EXPIRED:
                raise DriverError(f"an axis has error 0x{int(error[0]):x}; see `odrivetool`, dump_errors(odrv0, True)")
            require_watchdog(watchdog_ms, 1000 * timeout[0] if enabled[0] else 0.0)
        return float(watchdog_ms)

    def drive(self, command: VelocityCommand) -> Transaction[MotorStatus]:
        """Send both velocities and the requests for the status at once; a stop arms disarmed axes."""
        arming = self._disarmed and is_stop(command)
        speeds = self._drive.channels(command)
        lines = [f"v {axis} {mps * self._drive.turns_per_m:.5f}" for axis, mps in enumerate(speeds)]
        for axis in (0, 1) if arming else ():  # Clear its errors, and start closed-loop velocity control.
            lines += [f"w axis{axis}.controller.config.control_mode {VELOCITY_CONTROL}", f"w axis{axis}.error 0"]
            lines += [f"u {axis}", f"w axis{axis}.requested_state {CLOSED_LOOP}"]
        requests = ["f 0", "f 1", "r axis0.error", "r axis1.error", "r vbus_voltage"]
        first, second, first_error, second_error, battery = yield from self._query(lines, requests)
        flags = int(first_error[0]) | int(second_error[0])
        self._disarmed = bool(flags & WATCHDOG_EXPIRED) or (self._disarmed and not arming)
        (_, first_turns_per_s), (_, second_turns_per_s) = first, second  # position, velocity
        velocity_mps, yaw_rate_radps = self._drive.motion(
            first_turns_per_s / self._drive.turns_per_m, second_turns_per_s / self._drive.turns_per_m
        )
        return MotorStatus(velocity_mps, math.nan, yaw_rate_radps, self._disarmed, flags & ~WATCHDOG_EXPIRED,
                           battery[0])  # fmt: skip

    def _query(self, lines: Sequence[str], requests: Sequence[str]) -> Transaction[list[list[float]]]:
        """Write lines and requests, and return the numbers of each reply: two for "f", one for "r"."""
        replies: list[list[float]] = []
        frame = yield b"".join(map(with_checksum, [*lines, *requests]))
        while True:
            numbers = self._numbers(frame)
            if numbers and len(numbers) == (2 if requests[len(replies)][0] == "f" else 1):
                replies.append(numbers)
                if len(replies) == len(requests):
                    return replies
            else:
                replies.clear()  # a reply is missing, so those before cannot be assigned: this ends in the timeout
            frame = yield b""

    def _numbers(self, frame: bytes) -> list[float] | None:
        """Return the numbers of a reply, None if it is damaged; raise DriverError where it is an error message."""
        match = _CHECKED_LINE.fullmatch(frame)
        if match is None or int(match[2]) != _xor(match[1]):
            return None
        if match[1].startswith((b"invalid", b"unknown", b"not")):
            reply = match[1].decode("ascii", "replace")
            raise DriverError(f"it answered {reply!r}; a board with two axes and firmware 0.5 is needed")
        words = match[1].lower().replace(b"true", b"1").replace(b"false", b"0").split()
        try:
            numbers = [float(word) for word in words]
        except ValueError:
            return None
        return numbers if all(map(math.isfinite, numbers)) else None


def _xor(data: bytes) -> int:
    return functools.reduce(operator.xor, data, 0)
