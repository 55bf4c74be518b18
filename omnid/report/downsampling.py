"""Downsampling of series and paths of any length in bounded memory, without loss of spikes."""

from __future__ import annotations

import math
from operator import itemgetter
from typing import Final, NamedTuple

from omnid.core.mapping.thinned_path import ThinnedPath

BINS: Final = 500
LARGEST: Final = 1e9  # values beyond are invalid
_FINEST_S: Final = 1e-3
_FINEST_M: Final = 0.01
_CORNERS: Final = 4000

Point = tuple[float, float]  # time [s], value


class _Bin(NamedTuple):
    low: Point
    high: Point


class Downsampled:
    """Lowest and highest value of a series in each of at most BINS bins of time.

    All bins have the same length, which doubles whenever there are too many; values may come in any order.
    """

    def __init__(self) -> None:
        self._width_s = _FINEST_S
        self._bins: dict[int, _Bin] = {}
        self.count = 0
        self.newest = math.nan

    def add(self, t_s: float, value: float) -> None:
        """Add a value; one that is not finite, or larger than LARGEST, is left out."""
        if not (abs(value) <= LARGEST and abs(t_s) <= LARGEST):
            return
        self.count, self.newest = self.count + 1, value
        self._put(math.floor(t_s / self._width_s), _Bin((t_s, value), (t_s, value)))
        while len(self._bins) > BINS:
            self._widen()

    def points(self) -> list[Point]:
        """Return at most two points for each bin, in the order of time."""
        return sorted({point for bin_ in self._bins.values() for point in bin_})

    def _put(self, key: int, new: _Bin) -> None:
        old = self._bins.get(key, new)
        self._bins[key] = _Bin(min(old.low, new.low, key=itemgetter(1)), max(old.high, new.high, key=itemgetter(1)))

    def _widen(self) -> None:
        bins, self._bins, self._width_s = self._bins, {}, 2 * self._width_s
        for key, bin_ in bins.items():
            self._put(key // 2, bin_)


class Corner(NamedTuple):
    """A vertex of a path."""

    x_m: float
    y_m: float
    t_s: float
    rank: int  # worst state since the previous vertex


def path_trace() -> ThinnedPath[Corner]:
    """Return an empty path of at most 4000 vertices; each has the worst state since the one before it."""
    return ThinnedPath(_CORNERS, _FINEST_M, _is_step, _with_worse_rank)


def _is_step(last: Corner, new: Corner, step_m: float) -> bool:
    return math.dist(last[:2], new[:2]) >= step_m


def _with_worse_rank(dropped: Corner, new: Corner) -> Corner:
    return new._replace(rank=max(dropped.rank, new.rank))
