"""Vertical matching of two panoramas, for the edges of the lower one: three ways to choose among candidates.

`sad` takes the lowest SAD along the column (Dang et al. 2012, eq. (1)); `enhanced` settles several candidates by the
lines to anchors (section III.B); `semiglobal` searches only about a semi-global prior, and is the default.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol, TypeVar

import numpy as np
from numpy.typing import NDArray

from omnid.core.stereo.anchors import AnchorPropagation, Candidates
from omnid.core.stereo.edges import edge_pixels, smooth
from omnid.core.stereo.sad import NEVER, Costs, Indices, SadVolume, local_minima, subpixel
from omnid.core.stereo.semiglobal import SemiGlobalPrior
from omnid.settings import knob

Image = NDArray[np.uint8]
Flags = NDArray[np.bool_]
Floats = NDArray[np.float32]
Scalar = TypeVar("Scalar", bound=np.generic)
Matches = tuple[Indices, Floats]  # flat indices (N,) into the lower panorama, disparities (N,) > 0 [px]

METHODS = ("sad", "enhanced", "semiglobal")
REACH_PX = 3  # the prior comes from half the resolution and is rounded


@dataclass(frozen=True, slots=True)
class MatchingSettings:
    """How to match: the way of choosing, the SAD's window and threshold, and which edges."""

    method: str = knob("semiglobal", "how one of several candidates is chosen", choices=METHODS)
    window_px: int = knob(9, "side of the matching window, px; odd", low=3, high=15)
    disparities: int = knob(128, "largest disparity searched, px, however near the points wanted", low=8, high=512)
    max_difference: float = knob(
        12.0, "mean difference of grey levels in the window that is still a match", low=0, high=255
    )
    rival: float = knob(2.0, "enhanced: a candidate's SAD is at most this times the best one's,", low=1, high=10)
    rival_difference: float = knob(
        4.0, "plus so many grey levels; what has one candidate only is an anchor", low=0, high=255
    )
    edge_threshold: int = knob(40, "Sobel response that makes an edge, 8 per grey level and pixel", low=0, high=1020)
    max_points: int = knob(30_000, "edge pixels matched in a pair", low=100, high=1_000_000)
    sigma_px: float = knob(0.8, "deviation of the Gaussian before the edges, px", low=0, high=10)
    max_candidates: int = knob(8, "candidates compared for one pixel", low=2, high=64)


class CandidateSearch(Protocol):
    """A way of choosing among candidates."""

    def search(self, lower: Image, upper: Image, pixels: Indices) -> Matches:
        """The matches of some pixels of the lower panorama (H, W) in the upper one."""
        ...


class Matcher:
    """Finds edges of the lower panorama in the upper one; keeps its buffers between pairs."""

    def __init__(self, shape: tuple[int, int], matching: MatchingSettings) -> None:
        self._matching = matching
        self._search: CandidateSearch = SEARCHES[matching.method](shape, matching)

    def match(self, lower: Image, upper: Image, valid: Flags) -> Matches:
        """The matched pixels of panoramas (H, W) uint8 whose seam the caller has padded, where valid (H, W)."""
        lower, upper = smooth(lower, self._matching.sigma_px), smooth(upper, self._matching.sigma_px)
        pixels = edge_pixels(lower, valid, self._matching.edge_threshold, self._matching.max_points)
        return self._search.search(lower, upper, pixels)


class SemiGlobalSearch:
    """SAD within REACH_PX of a semi-global prior."""

    def __init__(self, shape: tuple[int, int], matching: MatchingSettings) -> None:
        self._prior = SemiGlobalPrior(matching.disparities)
        self._volume = SadVolume(shape, matching.disparities, matching.window_px)
        self._most = matching.max_difference * matching.window_px**2

    def search(self, lower: Image, upper: Image, pixels: Indices) -> Matches:
        """The pixels with a prior, and a minimum of the SAD near it."""
        prior = self._prior.disparity(lower, upper).reshape(-1)[pixels]
        pixels, rounded = pixels[np.isfinite(prior)], np.rint(prior[np.isfinite(prior)]).astype(np.intp)
        if not len(pixels):
            return pixels, np.zeros(0, np.float32)
        first, last = max(0, int(rounded.min()) - REACH_PX), int(rounded.max()) + REACH_PX
        self._volume.fill(lower, upper, range(first, min(last + 1, len(self._volume.planes))))
        costs = self._volume.around(pixels, rounded, REACH_PX)
        is_minimum = local_minima(costs, int(self._most))
        step = np.where(is_minimum, costs, NEVER).argmin(axis=0)
        disparity = rounded - REACH_PX + subpixel(costs, step)
        kept = is_minimum.any(axis=0) & (disparity > 0.5)
        return pixels[kept], disparity[kept].astype(np.float32)


class ColumnSearch:
    """The original: the lowest SAD along the whole column, with the left-right check (Dang et al. 2012, eq. (1))."""

    def __init__(self, shape: tuple[int, int], matching: MatchingSettings) -> None:
        self._volume = SadVolume(shape, matching.disparities, matching.window_px)
        self._most = matching.max_difference * matching.window_px**2

    def search(self, lower: Image, upper: Image, pixels: Indices) -> Matches:
        """The pixels whose lowest SAD is below the threshold, and is the lowest from the upper panorama as well."""
        self._volume.fill(lower, upper)
        costs = self._volume.at(pixels)
        disparity = costs.argmin(axis=0)
        choice, _ = self._volume.seen_from_upper(pixels, disparity)
        kept = _at(local_minima(costs, int(self._most)), disparity) & (np.abs(choice - disparity) <= 1)
        return pixels[kept], subpixel(costs, disparity)[kept]


class EnhancedSearch:
    """SAD along the whole column; points with several candidates are settled by anchors (section III.B)."""

    def __init__(self, shape: tuple[int, int], matching: MatchingSettings) -> None:
        self._matching = matching
        self._volume = SadVolume(shape, matching.disparities, matching.window_px)

    def search(self, lower: Image, upper: Image, pixels: Indices) -> Matches:
        """The pixels with a match that the upper panorama agrees with.

        Where the lines decided clearly it need only be one of the candidates there: bricks mislead either side.
        """
        self._volume.fill(lower, upper)
        costs = self._volume.at(pixels)
        disparity, minima = costs.argmin(axis=0), local_minima(costs, self._limit(costs.min(axis=0)))
        count = np.count_nonzero(minima, axis=0)
        kept, several = (count == 1) & _at(minima, disparity), count > 1
        kept[kept] = self._liked(pixels[kept], disparity[kept], best=True)
        settlement = AnchorPropagation((lower, upper), pixels, disparity)
        clear = settlement.settle(kept, self._candidates(costs, minima, count))
        disparity = settlement.disparity
        for which, best in ((clear, False), (several & ~clear & _at(minima, disparity), True)):
            kept[which] = self._liked(pixels[which], disparity[which], best)
        return pixels[kept], subpixel(costs, disparity)[kept]

    def _limit(self, lowest: Costs) -> Costs:
        """The largest SAD (N,) that makes a candidate: near the lowest one, and never above the threshold."""
        m, area = self._matching, self._matching.window_px**2
        near = lowest * m.rival + m.rival_difference * area
        return np.asarray(np.minimum(near, m.max_difference * area), np.uint16)

    def _liked(self, pixels: Indices, disparity: Indices, best: bool) -> Flags:
        """Whether a match is a candidate of the upper panorama's pixel as well, or even its best, to a pixel."""
        choice, lowest = self._volume.seen_from_upper(pixels, disparity)
        if best:
            return np.asarray(np.abs(choice - disparity) <= 1)
        cost = self._volume.around(pixels, disparity, 0)[0]
        return np.asarray(cost <= self._limit(lowest))

    def _candidates(self, costs: Costs, minima: Flags, count: Indices) -> Candidates:
        """The minima of the points with more than one (overwritten): of too many the lowest."""
        most = self._matching.max_candidates
        if (many := np.flatnonzero(count > most)).size:
            masked = np.where(minima[:, many], costs[:, many], NEVER)
            minima[:, many] &= masked <= np.partition(masked, most - 1, axis=0)[most - 1]
        disparity, point = np.divmod(np.flatnonzero(minima), len(count))
        rows = np.flatnonzero(count[point] > 1)
        disparity, point = disparity[rows], point[rows]
        difference = costs[disparity, point] / np.float32(self._matching.window_px**2)
        return Candidates(point, disparity, difference.astype(np.float32))


SEARCHES: dict[str, Callable[[tuple[int, int], MatchingSettings], CandidateSearch]] = {
    "semiglobal": SemiGlobalSearch, "enhanced": EnhancedSearch, "sad": ColumnSearch,
}


def _at(values: NDArray[Scalar], disparity: Indices) -> NDArray[Scalar]:
    """The values (D, N) at disparities (N,)."""
    return values[disparity, np.arange(len(disparity))]
