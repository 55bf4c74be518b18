"""What happened, in the order of time and in bounded memory."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass
from typing import Final

GOOD, WARNING, ERROR = range(3)
MOST: Final = 600
MOST_OF_ONE: Final = 80
_APART_S: Final = 2.5  # a counter that rises again within so long is one event: statuses come once a second
_LONGEST: Final = 160  # characters


@dataclass(slots=True)
class Event:
    """Something that happened, perhaps several times in a row."""

    start_s: float
    end_s: float
    level: int
    source: str
    text: str
    count: int = 0  # of a counter that rose; 0: it happened once


class Events:
    """The first MOST events, MOST_OF_ONE from each source; those beyond are counted."""

    def __init__(self) -> None:
        self._events: list[Event] = []
        self._running: dict[tuple[str, str], Event] = {}
        self._of: Counter[str] = Counter()
        self.beyond: Counter[str] = Counter()

    def add(self, event: Event) -> None:
        """Takes an event; the same one again, right after, only makes it longer."""
        event.source, event.text = event.source[:_LONGEST], event.text[:_LONGEST]
        same = self._running.get((event.source, event.text))
        if event.count and same is not None and abs(event.start_s - same.end_s) <= _APART_S:
            same.end_s, same.count = max(same.end_s, event.end_s), same.count + event.count
        elif len(self._events) < MOST and self._of[event.source] < MOST_OF_ONE:
            self._events.append(event)
            self._of[event.source] += 1
            self._running[event.source, event.text] = event
        else:
            self.beyond[event.source if event.source in self._of else "others"] += 1

    def in_order(self) -> list[Event]:
        """The events by their start."""
        return sorted(self._events, key=lambda event: event.start_s)
