"""The status entries of a recording: states, resets, counters that rose, and the course of numbers."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from typing import Final, NamedTuple

from omnid.report.downsampling import Downsampled
from omnid.report.events import ERROR, GOOD, WARNING, Event, Events, without_digits
from omnid.report.poses import STATES, UNKNOWN, PoseHistory
from omnid.transport import status_names
from omnid.transport.decode import Diagnostics
from omnid.transport.records import DiagnosticStatus
from omnid.transport.status_names import CAPTURE_TO_POSE, TICK_LATE, WORK, Key, short_name, time_key

MAX_ENTRIES: Final = 64
MAX_VALUES: Final = 64  # Most values of an entry.
_MAX_NAME: Final = 80  # characters
_MAX_VALUE: Final = 160  # characters
_MAX_SERIES: Final = 128
_MAX_COUNTERS: Final = 1024
_MAX_RESETS: Final = 10**10
_COUNTERS: Final[dict[str, str]] = {  # of faults, with the text of the event when one rises
    Key.DROPS: "images dropped",
    Key.DROPPED: "messages dropped",
    Key.MISSED: "deadlines missed",
    Key.ERRORS: "errors",
    Key.LOSSES: "camera lost",
    Key.RESTARTS: "stream restarted",
    Key.BROKEN: "images that cannot be decoded",
    Key.EXPIRIES: "watchdog expired",
    Key.UNPAIRED_LOWER: "lower images without a partner",
    Key.UNPAIRED_UPPER: "upper images without a partner",
}
_COUNTER_PREFIXES: Final = (status_names.STOPPED_PREFIX, status_names.REFUSED_PREFIX)  # of counters
_PLOTTED: Final = frozenset(
    {  # numbers whose course is kept
        Key.INLIERS,
        Key.TRACKED,
        Key.RATE_HZ,
        Key.AGE_S,
        Key.DROPPED,
        Key.MISSED,
        time_key(CAPTURE_TO_POSE, "p50"),
        time_key(CAPTURE_TO_POSE, "p99"),
        time_key(WORK, "p50"),
        time_key(TICK_LATE, "p99"),
        time_key(TICK_LATE, "max"),
    }
)


class _RunProgress(NamedTuple):
    """Numbers that only rise as long as a daemon runs."""

    stamp_ns: int
    resets: int
    length_m: float  # of the path; NaN where it is not reported

    def is_restarted_by(self, later: _RunProgress) -> bool:
        """True if a later entry shows that the daemon was started again in between."""
        return later.resets < self.resets or later.length_m < self.length_m


class StatusHistory:
    """Collects the entries of a recording in bounded memory."""

    def __init__(self, events: Events, poses: PoseHistory) -> None:
        """poses: told where the daemon was started again."""
        self._events, self._poses = events, poses
        # The newest numbers of the periodic reports (True), which have the length of the path, and of the reports of a
        # new state (False). The reports of each kind arrive in order.
        self._progress: dict[bool, _RunProgress] = {}
        self._counts: dict[tuple[str, str], int] = {}
        self._messages: dict[str, str] = {}
        self._state_ns = 0
        self._reset_counter: int | None = None
        self.rank = UNKNOWN  # of the newest state in STATES
        self.resets = 0
        self.reports = 0  # messages with the entries of all parts
        self.newest: dict[str, DiagnosticStatus] = {}
        self._series: dict[tuple[str, str], Downsampled] = {}

    def add(self, diagnostics: Diagnostics, seconds: Callable[[int], float]) -> None:
        """Add a message; seconds maps a stamp [ns] to the time since the first pose [s]."""
        t_s = seconds(diagnostics.stamp_ns)
        for status in map(_bounded, diagnostics.statuses):
            if status.name in self.newest or len(self.newest) < MAX_ENTRIES:
                self._add_entry(status, diagnostics.stamp_ns, t_s)
        self.reports += len(diagnostics.statuses) > 1

    def values(self, name: str) -> dict[str, str]:
        """Return the newest values of an entry."""
        return dict(self.newest[name].values) if name in self.newest else {}

    def series(self, name: str, key: str) -> Downsampled:
        """Return the course of a number."""
        return self._series.get((name, key), Downsampled())

    def stages(self) -> Iterator[tuple[str, dict[str, str]]]:
        """Yield name and newest values of every stage."""
        for name in self.newest:
            if name.startswith(status_names.STAGE_PREFIX):
                yield name.removeprefix(status_names.STAGE_PREFIX), self.values(name)

    def _add_entry(self, status: DiagnosticStatus, stamp_ns: int, t_s: float) -> None:
        if status.name == status_names.ODOMETRY:
            self._add_state(status, stamp_ns, t_s)
        elif status.name != status_names.SUMMARY:
            self._add_message(status, t_s)
        for key, value in status.values.items():
            self._add_value(status.name, key, value, t_s)
        known = self.newest[status.name].values if status.name in self.newest else {}
        merged = dict(list({**known, **status.values}.items())[:MAX_VALUES])
        self.newest[status.name] = DiagnosticStatus(status.name, status.level, status.message, merged)

    def _add_state(self, status: DiagnosticStatus, stamp_ns: int, t_s: float) -> None:
        """Update state and resets; entries may be recorded out of order, and older ones do not change the state."""
        state = status_names.tracking_state(status.message, status.values)
        if stamp_ns >= self._state_ns and state is not None:
            self.rank, self._state_ns = STATES.index(state), stamp_ns
        resets = status_names.count(status.values.get(Key.RESETS, ""))
        if resets is None or resets >= _MAX_RESETS:
            return
        self._add_progress(_RunProgress(stamp_ns, resets, _length_m(status)), t_s)
        before, self._reset_counter = self._reset_counter, max(resets, self._reset_counter or 0)
        if before is not None and self._reset_counter > before:
            self.resets += self._reset_counter - before
            self._events.add(Event(t_s, t_s, ERROR, "state", "odometry was reset, with an unknown gap"))

    def _add_progress(self, progress: _RunProgress, t_s: float) -> None:
        """Add an event where the daemon was started again; older entries, recorded out of order, say nothing."""
        is_periodic = not math.isnan(progress.length_m)
        before = self._progress.get(is_periodic, progress)
        if progress.stamp_ns < before.stamp_ns:
            return
        if before.is_restarted_by(progress):
            self._progress.clear()
            self._reset_counter = 0
            self._poses.begin_run()
            self._events.add(Event(t_s, t_s, WARNING, "state", "the robot was started again, with a new odom"))
        elif is_periodic or True not in self._progress:
            self._poses.continue_run()
        self._progress[is_periodic] = progress

    def _add_message(self, status: DiagnosticStatus, t_s: float) -> None:
        """Add an event where the message of a part changes; a change of digits only is not an event."""
        message = without_digits(status.message)
        before, self._messages[status.name] = self._messages.get(status.name), message
        if message and message != before and (before is not None or status.level > 0):
            level = (GOOD, WARNING, ERROR, ERROR)[min(status.level, 3)]
            self._events.add(Event(t_s, t_s, level, short_name(status.name), status.message))

    def _add_value(self, name: str, key: str, text: str, t_s: float) -> None:
        value = status_names.number(text)
        if value is None:
            return
        if (name, key) in self._series or (key in _PLOTTED and len(self._series) < _MAX_SERIES):
            self._series.setdefault((name, key), Downsampled()).add(t_s, value)
        count = status_names.count(text)
        if count is not None and (key in _COUNTERS or key.startswith(_COUNTER_PREFIXES)):
            self._add_count(name, key, count, t_s)

    def _add_count(self, name: str, key: str, count: int, t_s: float) -> None:
        """Add an event where a counter rose. Its value in the first message is from before the recording."""
        appeared = key.startswith(_COUNTER_PREFIXES) and self.reports > 0
        before = self._counts.get((name, key), 0 if appeared else count)
        if (name, key) in self._counts or len(self._counts) < _MAX_COUNTERS:
            self._counts[name, key] = count
        if count > before:
            self._events.add(Event(t_s, t_s, WARNING, short_name(name), _COUNTERS.get(key, key), count - before))


def _length_m(status: DiagnosticStatus) -> float:
    """Return the length of the path in an entry of the odometry, NaN without one."""
    length_m = status_names.number(status.values.get(Key.LENGTH_M, ""))
    return math.nan if length_m is None else length_m


def _bounded(status: DiagnosticStatus) -> DiagnosticStatus:
    values = {key[:_MAX_NAME]: value[:_MAX_VALUE] for key, value in list(status.values.items())[:MAX_VALUES]}
    return DiagnosticStatus(status.name[:_MAX_NAME], status.level, status.message[:_MAX_VALUE], values)
