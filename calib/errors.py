"""Errors of calibration files and calibrations."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager


class CalibError(Exception):
    """An unusable calibration file or value; its text is one line: what was expected, what was found, what to do."""


@contextmanager
def within(place: str) -> Iterator[None]:
    """Turn errors into CalibError, with the place (a file, a key) before their message unless it is there."""
    try:
        yield
    except (CalibError, ValueError, TypeError) as error:
        text = str(error)
        raise CalibError(text if text.startswith(place) else f"{place}{text}") from error
