"""Counters of every stage: messages, drops and durations, in bounded memory."""

from __future__ import annotations

import math
import time
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any, Final, TypeVar

from omnid.core.nanoseconds import S_PER_NS

T = TypeVar("T")

RECENT: Final = 1000  # durations whose distribution is known: ten seconds of the controller's ticks


class Histogram:
    """Distribution of the newest durations [s], their number, and the longest of all; one thread adds, any reads."""

    def __init__(self) -> None:
        self._recent_s: deque[float] = deque(maxlen=RECENT)
        self.count = 0
        self.max_s = math.nan

    def add(self, duration_s: float) -> None:
        """Add one duration."""
        self._recent_s.append(duration_s)
        self.max_s = duration_s if self.count == 0 else max(self.max_s, duration_s)
        self.count += 1

    def p(self, q: float) -> float:
        """Return the quantile q (0 to 1) of the newest durations, s; NaN before the first."""
        found_s = sorted(self._recent_s.copy())
        return found_s[max(0, math.ceil(q * len(found_s)) - 1)] if found_s else math.nan

    def times_ms(self) -> dict[str, float]:
        """Return median, 99th percentile and maximum, ms; NaN before the first."""
        return {"p50_ms": 1e3 * self.p(0.5), "p99_ms": 1e3 * self.p(0.99), "max_ms": 1e3 * self.max_s}


@dataclass(slots=True)
class StageStats:
    """Counters of one stage, source, sink or ticker: written by its own thread, `dropped` under its inbox's lock.

    A source's durations are the waits for its next message; a ticker's `dropped` are missed deadlines.
    `busy_since_ns` (CLOCK_MONOTONIC): since when a message is processed, or a ticker acts; 0 when idle.
    """

    name: str
    is_ticker: bool = False
    processed: int = 0
    dropped: int = 0
    busy_since_ns: int = 0
    wall: Histogram = field(default_factory=Histogram)

    def timed(self, call: Callable[..., T], *args: Any) -> T:
        """Return `call(*args)`, counted and timed; a call that raises is not counted."""
        start_ns = self.busy_since_ns = time.monotonic_ns()
        try:
            result = call(*args)
        finally:
            self.busy_since_ns = 0
        self.wall.add((time.monotonic_ns() - start_ns) * S_PER_NS)
        self.processed += 1
        return result


class Telemetry:
    """Registry of all counters of a run, in the order of the wiring."""

    def __init__(self) -> None:
        self.stages: list[StageStats] = []

    def add(self, stats: StageStats) -> StageStats:
        """Register the counters, whose name is that of no other stage, and return them."""
        assert stats.name not in [other.name for other in self.stages], stats.name
        self.stages.append(stats)
        return stats

    def of(self, name: str) -> StageStats:
        """Return the counters of a stage; StopIteration without it."""
        return next(stats for stats in self.stages if stats.name == name)

    def lost(self, *, by_tickers: bool) -> int:
        """Return the number of messages that were dropped in front of stages and sinks, or of missed deadlines."""
        return sum(stats.dropped for stats in self.stages if stats.is_ticker == by_tickers)

    def summary(self) -> dict[str, dict[str, float]]:
        """Return n (messages), drops, p50_ms, p99_ms and max_ms (time of one, NaN without any) by stage."""
        return {one.name: {"n": one.processed, "drops": one.dropped, **one.wall.times_ms()} for one in self.stages}
