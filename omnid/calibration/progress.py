"""Lines that a long calibration reports while it runs."""

from __future__ import annotations

from collections.abc import Callable

Progress = Callable[[str], None]


def silent(line: str) -> None:
    """Report nothing."""
