"""Exceptions of the drivers, each with one line: what was requested, found, and what to do; and events."""

from __future__ import annotations

from collections.abc import Callable
from typing import TypeAlias

EventCallback: TypeAlias = Callable[[int, str], None]  # takes a level of `logging` and one line of text


class DriverError(Exception):
    """A device or a log that cannot be used as requested."""


class FrameDecodeError(DriverError):
    """An image that cannot be decoded; the stream that delivered it continues."""


class RecordError(FrameDecodeError):
    """A record or a message with invalid content; those after it may be valid. The text identifies the record."""


def one_line(error: Exception) -> str:
    """Return an error of a library in one line of bounded length: it may quote a file, which may contain anything."""
    return " ".join(str(error).split())[:256] or type(error).__name__
