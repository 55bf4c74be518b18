"""Events of a run in the order of time, in bounded memory."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass
from typing import Final

GOOD, WARNING, ERROR = range(3)
MAX_PER_SOURCE: Final = 40
MAX_SOURCES: Final = 32
_MERGE_S: Final = 2.5  # a counter that rises again within this time is one event: status comes once a second
_MAX_DOUBLINGS: Final = 30  # of that time
_MAX_TEXT: Final = 160  # characters
_DIGITS: Final = str.maketrans("0123456789", "#" * 10)


def without_digits(text: str) -> str:
    """Return a text with a # for each group of digits, for comparisons in which numbers do not count."""
    return "#".join(part for part in text.translate(_DIGITS).split("#") if part)


@dataclass(slots=True)
class Event:
    """Something that happened once or several times."""

    start_s: float
    end_s: float
    level: int
    source: str
    text: str
    count: int = 0  # by which a counter rose, or number of merged events; 0: one event

    @property
    def kind(self) -> tuple[int, str]:
        """Level and text without digits: the same for events that differ in numbers only."""
        return self.level, without_digits(self.text)

    def merge(self, later: Event) -> None:
        """Become one with a later event of the same kind."""
        self.end_s = max(self.end_s, later.end_s)
        self.count = max(self.count, 1) + max(later.count, 1)


class _SourceEvents:
    """Events of one source. Beyond MAX_PER_SOURCE, those of a kind are merged, the nearest in time first."""

    def __init__(self) -> None:
        self.events: list[Event] = []
        self._newest: dict[tuple[int, str], Event] = {}
        self._merge_s = _MERGE_S
        self._full = False

    def add(self, event: Event) -> bool:
        """Add an event; False where there is no room for it."""
        if self._merged(event):
            return True
        if self._full:
            return False
        self._append(event)
        if len(self.events) > MAX_PER_SOURCE:
            self._shorten()
        return True

    def _merged(self, event: Event) -> bool:
        """Merge an event into the newest one of its kind; False where they are too far apart."""
        same = self._newest.get(event.kind)
        mergeable = event.count > 0 or self._merge_s > _MERGE_S
        if same is None or not mergeable or event.start_s - same.end_s > self._merge_s:
            return False
        same.merge(event)
        return True

    def _append(self, event: Event) -> None:
        self.events.append(event)
        self._newest[event.kind] = event

    def _shorten(self) -> None:
        for _ in range(_MAX_DOUBLINGS):
            self._merge_s *= 2
            events, self.events, self._newest = self.events, [], {}
            for event in events:
                if not self._merged(event):
                    self._append(event)
            if len(self.events) <= MAX_PER_SOURCE // 2:
                return
        self._full = True


class Events:
    """Events of all sources; those that find no room are counted by source."""

    def __init__(self) -> None:
        self._sources: dict[str, _SourceEvents] = {}
        self.left_out: Counter[str] = Counter()

    def add(self, event: Event) -> None:
        """Add an event."""
        event.source, event.text = event.source[:_MAX_TEXT], event.text[:_MAX_TEXT]
        if event.source not in self._sources and len(self._sources) >= MAX_SOURCES:
            self.left_out["others"] += 1
            return
        if not self._sources.setdefault(event.source, _SourceEvents()).add(event):
            self.left_out[event.source] += 1

    def in_order(self) -> list[Event]:
        """Return the events in the order of their start."""
        return sorted(
            (event for source in self._sources.values() for event in source.events), key=lambda event: event.start_s
        )
