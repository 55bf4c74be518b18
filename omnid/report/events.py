"""What happened, in the order of time and in bounded memory."""

from __future__ import annotations

import re
from collections import Counter
from dataclasses import dataclass
from typing import Final

GOOD, WARNING, ERROR = range(3)
MOST_OF_ONE: Final = 40
MOST_SOURCES: Final = 32
_APART_S: Final = 2.5  # a counter that rises again within so long is one event: statuses come once a second
_MOST_DOUBLINGS: Final = 30  # of that time
_LONGEST: Final = 160  # characters


@dataclass(slots=True)
class Event:
    """Something that happened, perhaps several times."""

    start_s: float
    end_s: float
    level: int
    source: str
    text: str
    count: int = 0  # of a counter that rose, or how often it happened; 0: once

    @property
    def kind(self) -> tuple[int, str]:
        """The same for what only differs in a figure."""
        return self.level, re.sub(r"\d+", "#", self.text)

    def take(self, later: Event) -> None:
        """Becomes both events."""
        self.end_s = max(self.end_s, later.end_s)
        self.count = max(self.count, 1) + max(later.count, 1)


class _Story:
    """What happened to one: more than MOST_OF_ONE events and those of a kind are put together, the nearest first."""

    def __init__(self) -> None:
        self.events: list[Event] = []
        self._newest: dict[tuple[int, str], Event] = {}
        self._apart_s = _APART_S
        self._full = False

    def add(self, event: Event) -> bool:
        """Whether it is told now."""
        if self._joined(event):
            return True
        if self._full:
            return False
        self._append(event)
        if len(self.events) > MOST_OF_ONE:
            self._shorten()
        return True

    def _joined(self, event: Event) -> bool:
        """Whether it is now part of the newest one of its kind."""
        same = self._newest.get(event.kind)
        joins = event.count > 0 or self._apart_s > _APART_S
        if same is None or not joins or event.start_s - same.end_s > self._apart_s:
            return False
        same.take(event)
        return True

    def _append(self, event: Event) -> None:
        self.events.append(event)
        self._newest[event.kind] = event

    def _shorten(self) -> None:
        for _ in range(_MOST_DOUBLINGS):
            self._apart_s *= 2
            events, self.events, self._newest = self.events, [], {}
            for event in events:
                if not self._joined(event):
                    self._append(event)
            if len(self.events) <= MOST_OF_ONE // 2:
                return
        self._full = True


class Events:
    """All that happened; what is one too many is counted by its source."""

    def __init__(self) -> None:
        self._stories: dict[str, _Story] = {}
        self.beyond: Counter[str] = Counter()

    def add(self, event: Event) -> None:
        """Takes an event."""
        event.source, event.text = event.source[:_LONGEST], event.text[:_LONGEST]
        if event.source not in self._stories and len(self._stories) >= MOST_SOURCES:
            self.beyond["others"] += 1
            return
        if not self._stories.setdefault(event.source, _Story()).add(event):
            self.beyond[event.source] += 1

    def in_order(self) -> list[Event]:
        """The events by their start."""
        return sorted((event for story in self._stories.values() for event in story.events),
                      key=lambda event: event.start_s)
