"""Events that a driver reports to the program that runs it."""

from __future__ import annotations

from collections.abc import Callable
from typing import Final, TypeAlias

EventCallback: TypeAlias = Callable[[int, str], None]  # severity and one line of text
WARNING: Final = 4  # severities of syslog and journald (RFC 5424, section 6.2.1)
NOTICE: Final = 5


def ignore_event(severity: int, text: str) -> None:
    """Drop an event."""
