"""Events that a driver reports to the program that runs it."""

from __future__ import annotations

from collections.abc import Callable
from typing import TypeAlias

EventCallback: TypeAlias = Callable[[int, str], None]  # level of `logging` and one line of text


def ignore_event(level: int, text: str) -> None:
    """Drop an event."""
