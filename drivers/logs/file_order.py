"""Order of a file against order in time: where the clock of a recorder was set back while it wrote."""

from __future__ import annotations

from array import array
from bisect import bisect_right
from collections.abc import Sequence
from itertools import pairwise
from typing import Final, NamedTuple, TypeAlias

import numpy as np

FEWEST_IN_ORDER: Final = 8  # Where fewer messages of a topic follow each other on average, it is written out of order.
LONGEST_STEP: Final = 1.5  # Where two messages are more periods apart than that, one is missing between them.
FAR_STEPS: Final = 3  # Times that end so many periods before others are of another clock.
LATEST_NS: Final = 2**62  # A time beyond is none; the difference of two times fits 64 bits.


def steps_back(times: Sequence[int]) -> list[int]:
    """Return the indices in the times of one topic, in the order of the file, at which its clock was set back.

    A file may also be written out of order: then what comes late fits into holes, or times go back at every
    few messages. After a step, times are covered again that were covered before, or others that lie far from them.
    """
    found = np.asarray(times, np.int64)
    increments = np.diff(found)
    back = np.flatnonzero(increments < 0) + 1
    if not back.size or FEWEST_IN_ORDER * back.size > increments.size:
        return []
    period = float(np.median(increments[increments > 0]))
    starts, low, high = [0], found[0], found[back[0] - 1]  # begins of segments; first and last time of the newest one
    for at, end in pairwise([*back.tolist(), len(found)]):
        run = found[at:end]  # which ascends
        within = run[np.searchsorted(run, low) : np.searchsorted(run, high, "right")]
        is_step = bool(run[-1] < low - FAR_STEPS * period)
        if within.size > 1:
            segment = found[starts[-1] : at]
            before = np.sort(segment[segment > within[0] - LONGEST_STEP * period])
            behind = np.searchsorted(before, within)
            again = np.count_nonzero((behind > 0) & (before[behind] - before[behind - 1] < LONGEST_STEP * period))
            is_step = is_step or bool(again > max(1, within.size / 2))
        if is_step:
            starts.append(at)
        low, high = (run[0], run[-1]) if is_step else (min(low, run[0]), max(high, run[-1]))
    return starts[1:]


Position: TypeAlias = tuple[int, int]  # in a file: of a block, and of a message in it


class _Topic(NamedTuple):
    """Times and positions of the messages of one topic, in the order of the file."""

    times: array[int]
    blocks: array[int]
    offsets: array[int]


class FileOrder:
    """The segments of a file: between two of them the recorder's clock was set back.

    Messages are sorted by time within a segment. The topics of images decide; other topics follow the first of them.
    """

    def __init__(self) -> None:
        self._topics: dict[str, _Topic] = {}
        self._cuts: dict[str, list[Position]] = {}
        self.spans_ns: dict[str, tuple[int, int]] = {}  # first and last time of each topic, once it is finished

    def add(self, topic: str, time_ns: int, position: Position) -> None:
        """Add a message of a topic of images, in the order of the file."""
        found = self._topics.setdefault(topic, _Topic(array("q"), array("q"), array("q")))
        for values, value in zip(found, (time_ns, *position), strict=True):
            values.append(min(value, LATEST_NS))

    def finish(self) -> None:
        """Find the segments, and forget the times."""
        for topic, found in self._topics.items():
            self._cuts[topic] = [(found.blocks[at], found.offsets[at]) for at in steps_back(found.times)]
            self.spans_ns[topic] = min(found.times), max(found.times)
        self._first = min((cuts for cuts in self._cuts.values() if cuts), key=lambda cuts: cuts[0], default=[])
        self._topics = {}

    @property
    def segments(self) -> int:
        """Number of segments."""
        return 1 + max(map(len, self._cuts.values()), default=0)

    def bounds(self, segment: int) -> tuple[Position | None, Position | None]:
        """Return positions before and behind all messages of a segment; None: begin and end of the file."""
        cut = [cuts for cuts in self._cuts.values() if cuts]
        begins = [cuts[segment - 1] for cuts in cut if 0 < segment <= len(cuts)]
        ends = [cuts[segment] for cuts in cut if segment < len(cuts)]
        return min(begins, default=None), max(ends) if cut and len(ends) == len(cut) else None

    def segment(self, topic: str, position: Position) -> int:
        """Return the number of the segment of a message."""
        return bisect_right(self._cuts.get(topic) or self._first, position)
