"""Stamps as text, and texts from outside made safe to show: names of files, messages, errors that quote them.

A terminal, a table and a page show the same: control characters, line breaks, characters that change the direction of
writing, and bytes of a file name that are no UTF-8 (PEP 383) appear as escapes such as \\x1b.
"""

from __future__ import annotations

from datetime import UTC, datetime
from typing import Final

MAX_CHARACTERS: Final = 400
MAX_ENTRIES: Final = 64  # of parts in a status, and of values in a part


def plain(text: str, max_length: int = MAX_CHARACTERS) -> str:
    """Return a text of printable characters, of which there are max_length at most."""
    shown = text[:max_length]
    escaped = (one if one.isprintable() else one.encode("unicode_escape").decode("ascii") for one in shown)
    return "".join(escaped)[:max_length]


def one_line(message: object, max_length: int = MAX_CHARACTERS) -> str:
    """Return a message in one line of printable characters; white space of any length becomes one blank."""
    return plain(" ".join(str(message).split()), max_length)


def utc(stamp_ns: int) -> str:
    """Return date and time of a stamp (ns), before the year 10000, to the millisecond in ISO 8601."""
    seconds, rest_ns = divmod(stamp_ns, 10**9)
    return f"{datetime.fromtimestamp(seconds, UTC):%Y-%m-%dT%H:%M:%S}.{rest_ns // 10**6:03}Z"
