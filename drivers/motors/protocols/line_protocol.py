"""A line protocol for a base with a heading input: messages <-> bytes, no I/O.

Grammar (ASCII; numbers are decimal integers of at most 6 digits without a plus sign; CR may precede LF):

    line    = "$" body "*" crc LF        at most 64 bytes
    crc     = 4 hexadecimal digits: CRC-16/CCITT-FALSE (polynomial 0x1021, start 0xFFFF) of the bytes of body
    body    = velocity | status | watchdog | armed

    host to controller
    velocity = "V," seq "," velocity "," heading "," yaw_rate          drive; the reply is a status
    watchdog = "W," time                                               set the watchdog; the reply is armed

    controller to host
    status   = "S," seq "," velocity "," heading "," yaw_rate "," battery "," fault "," expired
               [ "," contact ]
    armed    = "A," time                                               the watchdog time now in force

| field    | unit     | range           |                                                                          |
|----------|----------|-----------------|--------------------------------------------------------------------------|
| seq      | 1        | 0 .. 65535      | one more with each velocity line, after 65535 comes 0; a status repeats it |
| velocity | mm/s     | -10000 .. 10000 | forward                                                                  |
| heading  | mrad     | -3142 .. 3142   | counter-clockwise; 0 is where the base pointed when the watchdog was set |
| yaw_rate | mrad/s   | -20000 .. 20000 | counter-clockwise                                                        |
| battery  | mV       | -1 .. 100000    | -1 is unknown                                                            |
| fault    | 1        | 0 .. 65535      | 0 is none                                                                |
| expired  | 1        | 0, 1            | 1: the watchdog had stopped the wheels before this command               |
| contact  | 1        | 0 .. 3          | 1: a bumper is pressed; 2: a cliff sensor sees no floor; 3: both. Absent: 0 |
| time     | ms       | 20 .. 10000     |                                                                          |

A controller with a heading input steers to the heading; one without follows the yaw rate. Velocity 0 with yaw rate 0
stops both. The controller's watchdog stops the wheels when no valid velocity line arrives for the watchdog time; the
next one drives again. The controller ignores lines that do not match the grammar; the host sends the next one.
"""

from __future__ import annotations

import binascii
import math
import re
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import replace
from typing import Final, NamedTuple

from drivers.errors import DriverError
from drivers.motor import MotorStatus, VelocityCommand
from drivers.motors.protocols.differential_drive import DifferentialDrive
from drivers.motors.protocols.motor_protocol import TextFramer, Transaction, require_watchdog

SEQ_COUNT = 65536
MAX_LINE = 64  # bytes
_LINE = re.compile(rb"\$([VSWA](?:,-?[0-9]{1,6}){1,8})\*([0-9A-Fa-f]{4})\r?\n?")
_BUMPER, _CLIFF = 1, 2  # bits of the contact


class _Field(NamedTuple):
    """A number of a line with its range."""

    name: str
    unit: str
    low: int
    high: int


_MOTION: Final = (
    _Field("seq", "(a count)", 0, SEQ_COUNT - 1),
    _Field("velocity", "mm/s", -10_000, 10_000),
    _Field("heading", "mrad", -3142, 3142),
    _Field("yaw rate", "mrad/s", -20_000, 20_000),
)
_STATE: Final = (
    _Field("battery", "mV", -1, 100_000),
    _Field("fault", "(a number)", 0, 65535),
    _Field("expired", "(a flag)", 0, 1),
    _Field("contact", "(two bits)", 0, _BUMPER | _CLIFF),
)
_TIME: Final = (_Field("watchdog time", "ms", 20, 10_000),)
_FIELDS: Final = {"V": _MOTION, "S": (*_MOTION, *_STATE), "W": _TIME, "A": _TIME}


class ProtocolError(DriverError):
    """A line that does not match the grammar, or a number that is out of its range."""


def encode(kind: str, *numbers: int) -> bytes:
    """Return the line of a kind (V, S, W or A) with its numbers; raise ProtocolError for one out of its range.

    A contact of 0 is left out.
    """
    _check(kind, numbers)
    shown = numbers[:-1] if kind == "S" and not numbers[-1] else numbers
    body = ",".join([kind, *map(str, shown)]).encode()
    return b"$%b*%04X\n" % (body, crc16(body))


def decode(line: bytes) -> tuple[str, tuple[int, ...]]:
    """Return kind and numbers of a line, with or without its end; raise ProtocolError for any other bytes.

    What is before the last "$" belongs to a line that was cut. The numbers of a status without a contact end with 0.
    """
    match = _LINE.fullmatch(line[max(0, line.rfind(b"$")) :])
    if match is None:
        raise ProtocolError(f"{line[:MAX_LINE]!r} is not a line of the motor protocol; check port and baud rate")
    body, crc = match.groups()
    if int(crc, 16) != crc16(body):
        raise ProtocolError(f"{line[:MAX_LINE]!r} has a wrong checksum (found {crc16(body):04X}); check the cable")
    kind, *texts = body.decode("ascii").split(",")
    numbers = tuple(map(int, texts))
    if kind == "S" and len(numbers) == len(_FIELDS["S"]) - 1:
        numbers = (*numbers, 0)  # firmware without contacts
    _check(kind, numbers)
    return kind, numbers


def _check(kind: str, numbers: Sequence[int]) -> None:
    """Raise ProtocolError unless a line of a kind has these numbers."""
    fields = _FIELDS[kind]
    if len(numbers) != len(fields):
        raise ProtocolError(f"motor line {kind} has {len(numbers)} numbers, not {len(fields)}; check the firmware")
    for (name, unit, low, high), number in zip(fields, numbers, strict=True):
        if not low <= number <= high:
            raise ProtocolError(f"motor {name} {number:.6g} is outside {low} .. {high} {unit}; keep it inside")


def crc16(data: bytes) -> int:
    """Return the CRC-16/CCITT-FALSE of data; that of b"123456789" is 0x29B1."""
    return binascii.crc_hqx(data, 0xFFFF)


def velocity_line(seq: int, command: VelocityCommand) -> bytes:
    """Return the line of a command; raise ProtocolError for a number that is not finite or out of its range."""
    return encode("V", seq, *_motion(command))


def status_line(seq: int, status: MotorStatus) -> bytes:
    """Return the line of a status, as the controller writes it."""
    battery_mv = -1 if math.isnan(status.battery_v) else round(status.battery_v * 1000)
    contact = _BUMPER * status.bumper + _CLIFF * status.cliff
    return encode("S", seq, *_motion(status), battery_mv, status.fault, int(status.watchdog_expired), contact)


def command_of(numbers: Sequence[int]) -> VelocityCommand:
    """Return the command in the numbers of a velocity line; its stamp, which is not sent, is 0."""
    return VelocityCommand(0, *(milli / 1000 for milli in numbers[1:]))


def status_of(numbers: Sequence[int]) -> MotorStatus:
    """Return the status in the numbers of a status line."""
    _, velocity, heading, yaw_rate, battery_mv, fault, expired, contact = numbers
    battery_v = math.nan if battery_mv < 0 else battery_mv / 1000
    contacts = bool(contact & _BUMPER), bool(contact & _CLIFF)
    return MotorStatus(velocity / 1000, heading / 1000, yaw_rate / 1000, bool(expired), fault, battery_v, *contacts)


def _motion(source: VelocityCommand | MotorStatus) -> list[int]:
    """Return velocity, heading and yaw rate in thousandths; raise ProtocolError for what is not finite."""
    values = source.velocity_mps * 1000, source.heading_rad * 1000, source.yaw_rate_radps * 1000
    for (name, *_), value in zip(_MOTION[1:], values, strict=True):
        if not math.isfinite(value):
            raise ProtocolError(f"motor {name} is {value}; only finite numbers can be sent, send a stop instead")
    return list(map(round, values))


class LineProtocol:
    """The host's side of one connection.

    A controller measures its heading from where its watchdog was set. After a reconnection this happens again, so the
    last heading before it is added from then on; a rotation in between is lost.
    """

    baud = 115_200
    framer = TextFramer

    def __init__(self, drive: DifferentialDrive) -> None:
        self._drive = drive
        self._seq = 0
        self._zero_rad = 0.0  # heading at which the controller's heading is 0
        self._heading_rad = 0.0  # last reported

    def connect(self, watchdog_ms: int) -> Transaction[float]:
        """Set the watchdog and return the time in force [ms]; raise DriverError where another one is in force."""
        (in_force_ms,) = yield from self._answer(encode("W", watchdog_ms), "A")
        require_watchdog(watchdog_ms, in_force_ms)
        self._zero_rad = self._heading_rad
        return float(watchdog_ms)

    def drive(self, command: VelocityCommand, now_s: float) -> Transaction[MotorStatus]:
        """Send one velocity line and return the status with the same seq."""
        velocity_mps, yaw_rate_radps = self._drive.limited(command)
        heading_rad = math.remainder(command.heading_rad - self._zero_rad, math.tau)
        seq, self._seq = self._seq, (self._seq + 1) % SEQ_COUNT
        line = velocity_line(seq, VelocityCommand(0, velocity_mps, heading_rad, yaw_rate_radps))
        status = status_of((yield from self._answer(line, "S", seq)))
        self._heading_rad = math.remainder(status.heading_rad + self._zero_rad, math.tau)
        return replace(status, heading_rad=self._heading_rad)

    def _answer(self, line: bytes, kind: str, seq: int | None = None) -> Transaction[tuple[int, ...]]:
        """Send a line and return the numbers of the first line of this kind, with this seq if one is given."""
        frame = yield line
        while True:
            with suppress(ProtocolError):
                found, numbers = decode(frame)
                if found == kind and seq in (None, numbers[0]):
                    return numbers
            frame = yield b""
