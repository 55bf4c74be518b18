"""Interface between the driver of a serial port and the protocol of a controller: frames and transactions.

A protocol does no I/O. It consists of transactions: generators that yield the bytes to write (none: only wait), are
sent the next complete frame each time, and return the result. The driver runs a transaction up to a deadline;
the transaction itself waits without a limit:

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
_MAX_LINE = 256  # bytes


class NoReplyError(DriverError):
    """No reply before the timeout, from a port that is still there."""


Transaction: TypeAlias = Generator[bytes, bytes, T]


class Framer(Protocol):
    """Splits a byte stream, received in pieces of any size, into frames; needs bounded memory."""

    def feed(self, data: bytes) -> list[bytes]:
        """Return the frames that end in data."""

    def reset(self) -> None:
        """Discard the incomplete frame."""


class MotorProtocol(Protocol):
    """Commands <-> bytes of one kind of controller; one object serves one connection."""

    baud: int  # default of the controller

    @property
    def framer(self) -> Callable[[], Framer]:
        """What makes a new framer for the controller's replies."""

    def connect(self, watchdog_ms: int) -> Transaction[float]:
        """Set up the controller and its watchdog, and return the watchdog's time in force [ms].

        Raises DriverError where the controller does not take the settings.
        """

    def drive(self, command: VelocityCommand) -> Transaction[MotorStatus]:
        """Send a command and return the status; raise DriverError for a command that the controller rejects."""


def require_watchdog(requested_ms: int, in_force_ms: float) -> None:
    """Raise DriverError unless the requested watchdog time is in force."""
    if round(in_force_ms) != requested_ms:
        raise DriverError(
            f"watchdog of {requested_ms} ms requested, {in_force_ms:g} ms in force; set another motor.watchdog_ms"
        )


class TextFramer:
    """Splits text into lines that end in CR or LF; returns them without the end, and drops empty and too long ones."""

    def __init__(self) -> None:
        self._rest = b""

    def feed(self, data: bytes) -> list[bytes]:
        """Return the lines that end in data."""
        *lines, rest = (self._rest + data).replace(b"\r", b"\n").split(b"\n")
        self._rest = rest[: _MAX_LINE + 1]  # which is too long once it ends, if this cuts it
        return [line for line in lines if 0 < len(line) <= _MAX_LINE]

    def reset(self) -> None:
        """Discard the incomplete line."""
        self._rest = b""
