"""Plots and log lines from the status entries of a robot."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Final, Protocol

from omnid.plain_text import plain
from omnid.tracking_state import TrackingState
from omnid.transport import status_names
from omnid.transport.decode import Diagnostics
from omnid.transport.records import DiagnosticStatus
from omnid.transport.status_names import ODOMETRY, STAGE_PREFIX, parsed_time_key, short_name

STAGES: Final = ("pair", "dewarp", "stereo", "odometry", "mapping")
LEVELS: Final = ("INFO", "WARN", "ERROR", "WARN")  # Levels of rerun by the level of an entry.
STATISTICS: Final = ("p50", "p99")  # Statistics of times that are plotted.


def latencies(diagnostics: Diagnostics) -> Iterator[tuple[tuple[str, ...], float]]:
    """Yield names and ms: medians of the stages that make a pose, medians and 99th percentiles of all other times."""
    for status in diagnostics.statuses:
        for key, text in status.values.items():
            time, value_ms = parsed_time_key(key), status_names.number(text)
            if time is None or value_ms is None or time.statistic not in STATISTICS:
                continue
            if not status.name.startswith(STAGE_PREFIX):
                yield (plain(short_name(status.name)), f"{time.name} {time.statistic}"), value_ms
            elif status.name.removeprefix(STAGE_PREFIX) in STAGES and time.statistic == "p50":
                yield (status.name.removeprefix(STAGE_PREFIX),), value_ms


def odometry_state(diagnostics: Diagnostics) -> TrackingState | None:
    """Return the tracking state; None where the message has none."""
    found = (
        status_names.tracking_state(status.message, status.values)
        for status in diagnostics.statuses
        if status.name == ODOMETRY
    )
    return next((state for state in found if state is not None), None)


def odometry_landmarks(diagnostics: Diagnostics) -> tuple[int, int] | None:
    """Return inliers and tracked landmarks; None where the message has none."""
    found = (status_names.landmark_counts(status.values) for status in diagnostics.statuses if status.name == ODOMETRY)
    return next((counts for counts in found if counts is not None), None)


class StatusChanges:
    """Detects entries whose level or message changes, in constant memory."""

    def __init__(self, max_entries: int = 100) -> None:
        self._max_entries = max_entries
        self._last: dict[str, tuple[int, str]] = {}

    def __call__(self, diagnostics: Diagnostics) -> Iterator[tuple[str, str]]:
        """Yield log lines and their levels; the state of the odometry is logged with the poses."""
        for status in diagnostics.statuses:
            if status.name != ODOMETRY and self._changed(status):
                text = f"{short_name(status.name)}: {status.message or 'no message'}"
                yield plain(text), LEVELS[status.level % len(LEVELS)]

    def _changed(self, status: DiagnosticStatus) -> bool:
        before, now = self._last.get(status.name, (0, "")), (status.level, status.message)
        if status.name in self._last or len(self._last) < self._max_entries:
            self._last[status.name] = now
        return now != before


class Canvas(Protocol):
    """Target of the plots and log lines."""

    def latency(self, stamp_ns: int, name: tuple[str, ...], value_ms: float) -> None:
        """Plot a time in ms."""

    def line(self, stamp_ns: int, text: str, level: str) -> None:
        """Add a line to the log."""


def draw(diagnostics: Diagnostics, changes: StatusChanges, canvas: Canvas) -> None:
    """Draw the latencies, and a log line for each entry that has changed."""
    for name, value_ms in latencies(diagnostics):
        canvas.latency(diagnostics.stamp_ns, name, value_ms)
    for text, level in changes(diagnostics):
        canvas.line(diagnostics.stamp_ns, text, level)
