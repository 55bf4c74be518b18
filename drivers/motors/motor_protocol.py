"""What a controller's protocol is to the driver of the port: frames, and scripts of what to write and what comes back.

A protocol does no I/O. It is written as scripts, generators that yield the bytes to write (none: only listen), are
sent the next whole frame each time, and return what they were after. The driver runs a script within a deadline, so a
script simply goes on until it has heard what it wants and never counts its waits:

    def connect(self, watchdog_ms):
        frame = yield b"^RWD %d\\r" % watchdog_ms
        while frame != b"+":
            frame = yield b""
"""

from __future__ import annotations

from collections.abc import Callable, Generator
from typing import Protocol, TypeAlias, TypeVar

from drivers.errors import DriverError
from drivers.motor import MotorStatus, VelocityCommand

T = TypeVar("T")
Transaction: TypeAlias = Generator[bytes, bytes, T]


class Framer(Protocol):
    """Whole frames out of a byte stream in any pieces, in bounded memory."""

    garbage: int  # bytes that belonged to no whole frame

    def feed(self, data: bytes) -> list[bytes]:
        """The frames that end in data."""

    def reset(self) -> None:
        """Forgets the piece of a frame that is in hand."""


class MotorProtocol(Protocol):
    """Commands <-> bytes of one kind of controller; one object for one connection."""

    baud: int  # the controller's own default
    bad_frames: int  # frames that made no sense

    def framer(self) -> Framer:
        """A new one for its answers."""

    def connect(self, watchdog_ms: int) -> Transaction[float]:
        """Prepares the controller, has it stop by itself after watchdog_ms, and gives the time in force [ms].

        DriverError where it does not.
        """

    def drive(self, command: VelocityCommand, now_s: float) -> Transaction[MotorStatus]:
        """Hands a command over; now_s is any steady clock. DriverError for a command that it refuses."""


def request(data: bytes, parse: Callable[[bytes], T | None]) -> Transaction[T]:
    """Writes data and gives the first frame that parse knows."""
    frame = yield data
    while (found := parse(frame)) is None:
        frame = yield b""
    return found


def require_watchdog(asked_ms: int, in_force_ms: float) -> None:
    """DriverError unless the controller took the time that it was asked for."""
    if round(in_force_ms) != asked_ms:
        raise DriverError(f"watchdog of {asked_ms} ms asked, {in_force_ms:g} ms in force; ask for another")


class TextFramer:
    """Lines that end in CR or LF, without their end and without empty ones; one longer than `longest` is garbage."""

    def __init__(self, longest: int = 256) -> None:
        self.garbage = 0
        self._longest, self._line, self._lost = longest, bytearray(), False

    def feed(self, data: bytes) -> list[bytes]:
        """The lines that end in data."""
        lines = []
        for byte in data:
            if byte in b"\r\n":
                lines += self._ended()
            elif self._lost or len(self._line) >= self._longest:
                self._lose()
            else:
                self._line.append(byte)
        return lines

    def reset(self) -> None:
        """Forgets the line in hand."""
        self.garbage += len(self._line)
        self._line.clear()
        self._lost = False

    def _ended(self) -> list[bytes]:
        line = [bytes(self._line)] if self._line else []
        self._line.clear()
        self._lost = False
        return line

    def _lose(self) -> None:
        """The rest of a line that is too long is no line either."""
        self.garbage += len(self._line) + 1
        self._line.clear()
        self._lost = True
