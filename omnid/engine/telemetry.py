"""Counters of every stage: messages, drops and durations, in constant memory."""

from __future__ import annotations

import math
import time
from array import array
from bisect import bisect_left
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, field
from itertools import accumulate
from typing import Any, NamedTuple, TypeVar

from omnid.errors import OmnidError

T = TypeVar("T")

_LOW_S = 1e-6
_HIGH_S = 1e3
_BINS_PER_E = 1.0 / math.log(1.02)  # neighbouring bins differ by 2 %
_BINS = math.ceil(math.log(_HIGH_S / _LOW_S) * _BINS_PER_E)


class Histogram:
    """Distribution of durations from 1 us to 1000 s within 1 %, in 8 kB for any count.

    One thread adds; any thread may read at the same time and gets a state at most one duration old.
    """

    __slots__ = ("_bins", "_total_s", "count", "max_s")

    def __init__(self) -> None:
        self._bins = array("Q", bytes(8 * (_BINS + 2)))  # the first and the last are for values out of range
        self._total_s = 0.0
        self.count = 0
        self.max_s = math.nan

    def add(self, duration_s: float) -> None:
        """Add one duration."""
        self._bins[_bin(duration_s)] += 1
        self._total_s += duration_s
        self.max_s = duration_s if self.count == 0 else max(self.max_s, duration_s)
        self.count += 1

    @property
    def mean_s(self) -> float:
        """Mean duration, s; NaN before the first."""
        return self._total_s / self.count if self.count else math.nan

    def p(self, q: float) -> float:
        """Return the quantile q (0 to 1) of the durations, s; NaN before the first."""
        return self.quantiles(q)[0]

    def quantiles(self, *shares: float) -> list[float]:
        """Return several quantiles as `p`, of one state."""
        ranks = list(accumulate(self._bins[:]))
        return [self._quantile(ranks, share) for share in shares]

    def _quantile(self, ranks: list[int], q: float) -> float:
        """Return a quantile by the numbers of durations up to each bin."""
        if not 0.0 <= q <= 1.0:
            raise ValueError(f"a quantile is a fraction from 0 to 1, found {q}: for the 99th percentile ask p(0.99)")
        if ranks[-1] == 0:
            return math.nan
        rank = max(1, math.ceil(q * ranks[-1]))
        return self.max_s if rank == ranks[-1] else min(_centre_s(bisect_left(ranks, rank)), self.max_s)


def _bin(duration_s: float) -> int:
    if duration_s < _LOW_S:
        return 0
    return 1 + int(min(math.log(duration_s / _LOW_S) * _BINS_PER_E, _BINS))


def _centre_s(index: int) -> float:
    return min(_LOW_S * math.exp(max(index - 0.5, 0.0) / _BINS_PER_E), _HIGH_S)


class Stopwatch:
    """Wall time and processor time of the calling thread [ns], from its creation on, without pauses."""

    __slots__ = ("_cpu_ns", "_wall_ns")

    def __init__(self) -> None:
        self._wall_ns, self._cpu_ns = -time.perf_counter_ns(), -time.thread_time_ns()

    def pause(self) -> None:
        """Stop; elapsed_ns may be read."""
        self._wall_ns += time.perf_counter_ns()
        self._cpu_ns += time.thread_time_ns()

    def resume(self) -> None:
        """Go on."""
        self._wall_ns -= time.perf_counter_ns()
        self._cpu_ns -= time.thread_time_ns()

    @property
    def elapsed_ns(self) -> tuple[int, int]:
        """Wall and processor time while it ran; it must be paused."""
        return self._wall_ns, self._cpu_ns


@dataclass(slots=True)
class StageStats:
    """Counters of one stage, source, sink or ticker: written by its own thread, `dropped` under its inbox's lock.

    A source's durations are the waits for its next message; a ticker's `dropped` are missed deadlines.
    `busy_since_ns` (CLOCK_MONOTONIC): since when a message waits or is processed and none has been finished; 0 when
    idle. Only stages with an inbox and tickers set it.
    """

    name: str
    processed: int = 0
    dropped: int = 0
    busy_since_ns: int = 0
    wall: Histogram = field(default_factory=Histogram)
    cpu: Histogram = field(default_factory=Histogram)  # time of the processor, of the calling thread only

    def timed(self, call: Callable[..., T], *args: Any) -> T:
        """Return `call(*args)`, counted and timed; a call that raises is not counted."""
        watch = Stopwatch()
        result = call(*args)
        self.count(watch)
        return result

    def timed_each(self, messages: Iterable[T]) -> Iterator[T]:
        """Yield the messages, each counted and timed."""
        watch = Stopwatch()
        for message in messages:
            self.count(watch)
            yield message
            watch = Stopwatch()

    def count(self, watch: Stopwatch) -> None:
        """Stop a running stopwatch, and count a message with the time that it took."""
        watch.pause()
        wall_ns, cpu_ns = watch.elapsed_ns
        self.wall.add(wall_ns * 1e-9)
        self.cpu.add(cpu_ns * 1e-9)
        self.processed += 1


class SummaryRow(NamedTuple):
    """One printed line: wall time per message in milliseconds, NaN if no message was processed."""

    stage: str
    n: int
    drops: int
    p50_ms: float
    p99_ms: float
    max_ms: float


class Telemetry:
    """Registry of all counters of a run, in the order of the wiring."""

    def __init__(self) -> None:
        self._stages: dict[str, StageStats] = {}

    def add(self, stats: StageStats) -> StageStats:
        """Register the counters and return them; OmnidError if another stage has their name."""
        if stats.name in self._stages:
            raise OmnidError(f"stage '{stats.name}': the name is in use, choose another one")
        self._stages[stats.name] = stats
        return stats

    def of(self, name: str) -> StageStats:
        """Return the counters of a stage; KeyError without it."""
        return self._stages[name]

    @property
    def stages(self) -> tuple[StageStats, ...]:
        """All counters."""
        return tuple(self._stages.values())

    def summary(self) -> list[SummaryRow]:
        """Return one row per stage, for printing."""
        return [_row(stats) for stats in self.stages]


def _row(stats: StageStats) -> SummaryRow:
    p50_ms, p99_ms, max_ms = (1e3 * value_s for value_s in (*stats.wall.quantiles(0.5, 0.99), stats.wall.max_s))
    return SummaryRow(stats.name, stats.processed, stats.dropped, p50_ms, p99_ms, max_ms)
