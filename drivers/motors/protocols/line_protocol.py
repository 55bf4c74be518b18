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
from typing import Final

from drivers.errors import DriverError
from drivers.motor import MotorStatus, VelocityCommand
from drivers.motors.protocols.motor_protocol import DifferentialDrive, TextFramer, Transaction, require_watchdog

SEQ_COUNT: Final = 65536
_LINE: Final = re.compile(rb"\$([VSWA](?:,-?[0-9]{1,6}){1,8})\*([0-9A-Fa-f]{4})\r?\n?")
BUMPER, CLIFF = 1, 2  # bits of the contact

# Lowest and highest number of each field, and the fields of each kind of line, as above.
_RANGES: Final = {
    "seq": (0, SEQ_COUNT - 1),
    "velocity": (-10_000, 10_000),
    "heading": (-3142, 3142),
    "yaw rate": (-20_000, 20_000),
    "battery": (-1, 100_000),
    "fault": (0, 65535),
    "expired": (0, 1),
    "contact": (0, BUMPER | CLIFF),
    "time": (20, 10_000),
}
_MOTION: Final = ("seq", "velocity", "heading", "yaw rate")
_STATUS: Final = (*_MOTION, "battery", "fault", "expired", "contact")
_FIELDS: Final = {"V": _MOTION, "S": _STATUS, "W": ("time",), "A": ("time",)}


def encode(kind: str, *numbers: int) -> bytes:
    """Return the line of a kind (V, S, W or A) with its numbers; raise DriverError for one out of its range.

    A contact of 0 is left out.
    """
    for name, number in zip(_FIELDS[kind], numbers, strict=True):
        low, high = _RANGES[name]
        if not low <= number <= high:
            raise DriverError(f"motor {name} {number} is outside {low} .. {high}; keep it inside")
    sent = numbers[:-1] if kind == "S" and not numbers[-1] else numbers
    body = ",".join([kind, *map(str, sent)]).encode()
    return b"$%b*%04X\n" % (body, crc16(body))


def decode(line: bytes) -> tuple[str, tuple[int, ...]] | None:
    """Return kind and numbers of a line, with or without its end; None for any other bytes.

    What is before the last "$" belongs to a line that was cut. The numbers of a status without a contact end with 0.
    """
    match = _LINE.fullmatch(line[max(0, line.rfind(b"$")) :])
    if match is None or int(match[2], 16) != crc16(match[1]):
        return None
    kind, *texts = match[1].decode("ascii").split(",")
    fields, numbers = _FIELDS[kind], tuple(map(int, texts))
    if kind == "S" and len(numbers) == len(fields) - 1:
        numbers = (*numbers, 0)  # firmware without contacts
    if len(numbers) != len(fields):
        return None
    ranges = (_RANGES[name] for name in fields)
    in_range = all(low <= number <= high for (low, high), number in zip(ranges, numbers, strict=True))
    return (kind, numbers) if in_range else None


def crc16(data: bytes) -> int:
    """Return the CRC-16/CCITT-FALSE of data; that of b"123456789" is 0x29B1."""
    return binascii.crc_hqx(data, 0xFFFF)


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

    def drive(self, command: VelocityCommand) -> Transaction[MotorStatus]:
        """Send one velocity line and return the status with the same seq."""
        velocity_mps, yaw_rate_radps = self._drive.limited(command)
        heading_rad = math.remainder(command.heading_rad - self._zero_rad, math.tau)
        seq, self._seq = self._seq, (self._seq + 1) % SEQ_COUNT
        motion = (round(value * 1000) for value in (velocity_mps, heading_rad, yaw_rate_radps))
        answer = yield from self._answer(encode("V", seq, *motion), "S", seq)
        _, velocity, heading, yaw_rate, battery_mv, fault, expired, contact = answer
        self._heading_rad = math.remainder(heading / 1000 + self._zero_rad, math.tau)
        battery_v = math.nan if battery_mv < 0 else battery_mv / 1000
        return MotorStatus(
            velocity / 1000,
            self._heading_rad,
            yaw_rate / 1000,
            bool(expired),
            fault,
            battery_v,
            bool(contact & BUMPER),
            bool(contact & CLIFF),
        )

    def _answer(self, line: bytes, kind: str, seq: int | None = None) -> Transaction[tuple[int, ...]]:
        """Send a line and return the numbers of the first line of this kind, with this seq if one is given."""
        frame = yield line
        while True:
            found = decode(frame)
            if found is not None and found[0] == kind and seq in (None, found[1][0]):
                return found[1]
            frame = yield b""
