"""What a recording's diagnostics come to: states, counters, rates and times of the daemon's parts."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator
from typing import Final

from omnid.report.downsampling import Downsampled
from omnid.report.events import ERROR, GOOD, WARNING, Event, Events
from omnid.report.poses import STATES, UNKNOWN
from omnid.transport.codec import DiagnosticStatus
from omnid.transport.decode import Diagnostics

ODOMETRY: Final = "omnid: odometry"
SUMMARY: Final = "omnid: summary"
STAGE: Final = "omnid: stage "
_OWN: Final = "omnid: "
_MOST_PARTS: Final = 64
_MOST_VALUES: Final = 64  # of a part
_LONGEST: Final = 80  # characters of a name, half of those of a value
_LANDMARKS: Final = re.compile(r"(\d{1,9}) of (\d{1,9})")
_NUMBER: Final = re.compile(r"-?\d{1,15}(\.\d{1,15})?")
_TROUBLE: Final = ("drops", "dropped", "missed", "errors", "losses", "restarts", "broken", "expiries", "unpaired_lower",
                   "unpaired_upper")  # counters that should stand still
_DRAWN: Final = ("agree", "found", "rate_hz", "age_s", "capture_to_pose_p50_ms", "capture_to_pose_p99_ms", "dropped",
                 "missed", "work_p50_ms", "tick_late_p99_ms", "tick_late_max_ms")  # numbers whose course is kept
_MOST_COURSES: Final = 128
_MOST_COUNTS: Final = 1024
_TROUBLES: Final = ("stopped, ", "refused, ")  # beginnings of such


class StatusHistory:
    """Takes the diagnostics one after the other; seconds: from a stamp [ns] to s since the first pose."""

    def __init__(self, events: Events) -> None:
        self._events = events
        self._counts: dict[tuple[str, str], int] = {}
        self._said: dict[str, str] = {}
        self._state_ns = 0
        self._resets: int | None = None
        self.rank = UNKNOWN
        self.resets = 0
        self.reports = 0
        self.newest: dict[str, DiagnosticStatus] = {}
        self.course: dict[tuple[str, str], Downsampled] = {}

    def process(self, report: Diagnostics, seconds: Callable[[int], float]) -> None:
        """Takes what the parts of the robot said at a time."""
        t_s = seconds(report.stamp_ns)
        for status in map(_bounded, report.statuses):
            if status.name in self.newest or len(self.newest) < _MOST_PARTS:
                self._take(status, report.stamp_ns, t_s)
        self.reports += len(report.statuses) > 1

    def values(self, name: str) -> dict[str, str]:
        """What a part said last."""
        return dict(self.newest[name].values) if name in self.newest else {}

    def series(self, name: str, key: str) -> Downsampled:
        """The course of a number that a part told."""
        return self.course.get((name, key), Downsampled())

    def stages(self) -> Iterator[tuple[str, dict[str, str]]]:
        """Name and newest values of every stage."""
        for name in self.newest:
            if name.startswith(STAGE):
                yield name.removeprefix(STAGE), self.values(name)

    def _take(self, status: DiagnosticStatus, stamp_ns: int, t_s: float) -> None:
        if status.name == ODOMETRY:
            self._note_state(status, stamp_ns, t_s)
        elif status.name != SUMMARY:
            self._note_words(status, t_s)
        for key, value in status.values.items():
            self._note_value(status.name, key, (t_s, value))
        known = self.newest[status.name].values if status.name in self.newest else {}
        merged = dict(list({**known, **status.values}.items())[:_MOST_VALUES])
        self.newest[status.name] = DiagnosticStatus(status.name, status.level, status.message, merged)

    def _note_state(self, status: DiagnosticStatus, stamp_ns: int, t_s: float) -> None:
        """Reports may overtake each other: an older one changes nothing."""
        said = status.values.get("state", status.message)
        if stamp_ns >= self._state_ns and said in STATES:
            self.rank, self._state_ns = STATES.index(said), stamp_ns
        resets = status.values.get("resets", "")
        if resets.isdecimal() and len(resets) < 10:
            before, self._resets = self._resets, max(int(resets), self._resets or 0)
            if before is not None and self._resets > before:
                self.resets += self._resets - before
                self._events.add(Event(t_s, t_s, ERROR, "state", "odometry began anew, with an unknown gap"))

    def _note_words(self, status: DiagnosticStatus, t_s: float) -> None:
        """A part that says something new; figures within do not count, they change all the time."""
        said = re.sub(r"\d+", "#", status.message)
        before, self._said[status.name] = self._said.get(status.name), said
        if said and said != before and (before is not None or status.level > 0):
            level = (GOOD, WARNING, ERROR, ERROR)[min(status.level, 3)]
            self._events.add(Event(t_s, t_s, level, short(status.name), status.message))

    def _note_value(self, name: str, key: str, value: tuple[float, str]) -> None:
        t_s, text = value
        landmarks = _LANDMARKS.fullmatch(text) if key == "landmarks" else None
        if landmarks:
            for which, count in zip(("agree", "found"), landmarks.groups(), strict=True):
                self._add(name, which, (t_s, float(count)))
        elif _NUMBER.fullmatch(text):
            self._add(name, key, (t_s, float(text)))
            if text.isdecimal() and (key in _TROUBLE or key.startswith(_TROUBLES)):
                self._note_count(name, key, (t_s, int(text)))

    def _add(self, name: str, key: str, point: tuple[float, float]) -> None:
        if (name, key) in self.course or (key in _DRAWN and len(self.course) < _MOST_COURSES):
            self.course.setdefault((name, key), Downsampled()).add(*point)

    def _note_count(self, name: str, key: str, point: tuple[float, int]) -> None:
        """A counter that rose. Where it stood at the first report is of the time before."""
        t_s, count = point
        known = key.startswith(_TROUBLES) and self.reports > 0  # such a counter is there from its first count on
        before = self._counts.get((name, key), 0 if known else count)
        if (name, key) in self._counts or len(self._counts) < _MOST_COUNTS:
            self._counts[name, key] = count
        if count > before:
            self._events.add(Event(t_s, t_s, WARNING, short(name), _worded(key), count - before))


def short(name: str) -> str:
    """The name of a part without the daemon's."""
    return name.removeprefix(_OWN)


def _worded(key: str) -> str:
    words = {"drops": "images dropped", "dropped": "messages dropped", "missed": "deadlines missed",
             "broken": "images that cannot be decoded", "losses": "camera lost", "expiries": "watchdog expired",
             "restarts": "stream started anew", "unpaired_lower": "lower images without a partner",
             "unpaired_upper": "upper images without a partner"}
    return words.get(key, key)


def _bounded(status: DiagnosticStatus) -> DiagnosticStatus:
    values = {key[:_LONGEST]: value[:2 * _LONGEST] for key, value in list(status.values.items())[:_MOST_VALUES]}
    return DiagnosticStatus(status.name[:_LONGEST], status.level, status.message[:2 * _LONGEST], values)
