"""What can be drawn of the reports that the parts of a robot give."""

from __future__ import annotations

import math
import re
from collections.abc import Iterator
from typing import Final, Protocol

from omnid.monitor.robot_state import plain
from omnid.transport.codec import DiagnosticStatus
from omnid.transport.decode import Diagnostics
from omnid.viewer.style import STATES

STAGES: Final = ("pair", "dewarp", "stereo", "odometry", "mapping")
ODOMETRY: Final = "omnid: odometry"
LEVELS: Final = ("INFO", "WARN", "ERROR", "WARN")
_TIME: Final = re.compile(r"(?P<what>\w+?)_(?P<which>p50|p99)_ms")
_LANDMARKS: Final = re.compile(r"(\d{1,9}) of (\d{1,9})")


def latencies(report: Diagnostics) -> Iterator[tuple[tuple[str, ...], float]]:
    """Names and ms of what took its time: of the stages that make a pose the medians, of all that is no stage p99 too.
    """
    for status in report.statuses:
        part = status.name.removeprefix("omnid: ")
        for key, value in status.values.items():
            found, value_ms = _TIME.fullmatch(key), _number(value)
            if found is None or value_ms is None:
                continue
            if not part.startswith("stage "):
                yield (plain(part), f"{found['what']} {found['which']}"), value_ms
            elif part.removeprefix("stage ") in STAGES and found["which"] == "p50":
                yield (part.removeprefix("stage "),), value_ms


def state(report: Diagnostics) -> str | None:
    """The state of the odometry, where the report tells one."""
    found = (status.message for status in report.statuses if status.name == ODOMETRY)
    return next((message for message in found if message in STATES), None)


def landmarks(report: Diagnostics) -> tuple[int, int] | None:
    """How many landmarks agree, and how many were found."""
    found = _LANDMARKS.fullmatch(report.value(ODOMETRY, "landmarks"))
    return (int(found[1]), int(found[2])) if found else None


class StatusChanges:
    """What parts say of themselves, where it is not what they said before; in constant memory."""

    def __init__(self, most_parts: int = 100) -> None:
        self._most_parts = most_parts
        self._said: dict[str, tuple[int, str]] = {}

    def __call__(self, report: Diagnostics) -> Iterator[tuple[str, str]]:
        """Lines and their levels; the odometry's state is told elsewhere."""
        for status in report.statuses:
            if status.name != ODOMETRY and self._is_new(status):
                told = f"{status.name.removeprefix('omnid: ')}: {status.message or 'no message'}"
                yield plain(told), LEVELS[status.level % len(LEVELS)]

    def _is_new(self, status: DiagnosticStatus) -> bool:
        before, now = self._said.get(status.name, (0, "")), (status.level, status.message)
        if status.name in self._said or len(self._said) < self._most_parts:
            self._said[status.name] = now
        return now != before


class Canvas(Protocol):
    """What reports are drawn on."""

    def latency(self, stamp_ns: int, name: tuple[str, ...], value_ms: float) -> None:
        """How long something took, ms."""

    def line(self, stamp_ns: int, text: str, level: str) -> None:
        """A line of the log."""


def draw(report: Diagnostics, changes: StatusChanges, canvas: Canvas) -> None:
    """Draws how long things took, and what has changed."""
    for name, value_ms in latencies(report):
        canvas.latency(report.stamp_ns, name, value_ms)
    for text, level in changes(report):
        canvas.line(report.stamp_ns, text, level)


def _number(text: str) -> float | None:
    try:
        value = float(text)
    except ValueError:
        return None
    return value if math.isfinite(value) else None
