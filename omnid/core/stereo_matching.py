"""Vertical matching of two panoramas, for the edges of the lower one: three ways to choose among candidates.

`sad` takes the lowest SAD along the column (Dang et al. 2012, eq. (1)); `enhanced` settles several candidates by the
lines to an anchor (section III.B); `semiglobal` searches only about a semi-global prior, and is the default.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from omnid.core.disambiguation import line_difference, nearest_anchor
from omnid.core.edges import edge_pixels, smooth
from omnid.core.sad import NEVER, Costs, Indices, SadVolume, local_minima, subpixel
from omnid.core.semiglobal import SemiGlobalPrior

Image = NDArray[np.uint8]
Flags = NDArray[np.bool_]
Floats = NDArray[np.float32]
Matches = tuple[Indices, Floats]  # flat indices (N,) into the lower panorama, disparities (N,) > 0 [px]

METHODS = ("semiglobal", "enhanced", "sad")
REACH_PX = 3  # the prior comes from half the resolution and is rounded


@dataclass(frozen=True, slots=True)
class Matching:
    """How to match: the way of choosing, the SAD's window and threshold, and which edges."""

    method: str = "semiglobal"
    window_px: int = 9
    disparities: int = 64
    max_difference: float = 12.0  # mean grey level difference in the window that is still a match
    rival: float = 1.25  # a candidate is one whose SAD is at most this times the best one's, plus one grey level
    edge_threshold: int = 40
    max_points: int = 30_000
    sigma_px: float = 0.8
    max_candidates: int = 4


class Matcher:
    """Finds edges of the lower panorama in the upper one; keeps its buffers between pairs."""

    def __init__(self, shape: tuple[int, int], matching: Matching) -> None:
        self._matching = matching
        search = SemiGlobalSearch if matching.method == "semiglobal" else ColumnSearch
        self._search: SemiGlobalSearch | ColumnSearch = search(shape, matching)

    def match(self, lower: Image, upper: Image, valid: Flags) -> Matches:
        """The matched pixels of panoramas (H, W) uint8 whose seam the caller has padded, where valid (H, W)."""
        lower, upper = smooth(lower, self._matching.sigma_px), smooth(upper, self._matching.sigma_px)
        pixels = edge_pixels(lower, valid, self._matching.edge_threshold, self._matching.max_points)
        return self._search.search(lower, upper, pixels)


class SemiGlobalSearch:
    """SAD within REACH_PX of a semi-global prior."""

    def __init__(self, shape: tuple[int, int], matching: Matching) -> None:
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
    """SAD along the whole column, with the left-right check; enhanced by anchors or as it stands."""

    def __init__(self, shape: tuple[int, int], matching: Matching) -> None:
        self._matching = matching
        self._volume = SadVolume(shape, matching.disparities, matching.window_px)

    def search(self, lower: Image, upper: Image, pixels: Indices) -> Matches:
        """The pixels with a candidate that the upper panorama would choose as well."""
        self._volume.fill(lower, upper)
        costs = self._volume.at(pixels)
        minima = local_minima(costs, self._limit(costs))
        disparity = np.where(minima, costs, NEVER).argmin(axis=0)
        if self._matching.method == "enhanced":
            self._settle(lower, upper, pixels, (costs, minima, disparity))
        kept = minima.any(axis=0) & (np.abs(self._volume.seen_from_upper(pixels, disparity) - disparity) <= 1)
        return pixels[kept], subpixel(costs[:, kept], disparity[kept])

    def _limit(self, costs: Costs) -> Costs:
        """The largest SAD (N,) that makes a candidate: near the best one, and never above the threshold."""
        area = self._matching.window_px**2
        near = costs.min(axis=0) * self._matching.rival + area
        return np.asarray(np.minimum(near, self._matching.max_difference * area), np.uint16)

    def _settle(self, lower: Image, upper: Image, pixels: Indices, found: tuple[Costs, Flags, Indices]) -> None:
        """Overwrites the disparities of the points with several candidates, by the lines to their nearest anchors."""
        costs, minima, disparity = found
        candidates = minima.sum(axis=0)
        several, anchors = np.flatnonzero(candidates > 1), np.flatnonzero(candidates == 1)
        if not len(several) or not len(anchors):
            return
        rank, cost = _lowest(costs[:, several], minima[:, several], self._matching.max_candidates)
        anchor = anchors[nearest_anchor(lower.shape, pixels[anchors], pixels[several])]
        k, point = np.nonzero(cost < NEVER)
        start = _positions(pixels[several[point]], lower.shape[1])
        end = _positions(pixels[anchor[point]], lower.shape[1])
        shifted = (_below(start, rank[k, point]), _below(end, disparity[anchor[point]]))
        total = np.full(cost.shape, np.inf, np.float32)
        total[k, point] = cost[k, point] / self._matching.window_px**2
        total[k, point] += line_difference(lower, upper, (start, end, *shifted))
        disparity[several] = np.take_along_axis(rank, total.argmin(axis=0)[None], axis=0)[0]


def _lowest(costs: Costs, minima: Flags, most: int) -> tuple[Indices, Costs]:
    """The disparities (K, N) of the K lowest minima of costs (D, N) and their costs; NEVER where there are fewer."""
    masked = np.where(minima, costs, NEVER)
    rank = np.argsort(masked, axis=0)[:most]
    return rank, np.take_along_axis(masked, rank, axis=0)


def _positions(pixels: Indices, width: int) -> Floats:
    """(column, row) (N, 2) of flat indices."""
    return np.stack([pixels % width, pixels // width], axis=1).astype(np.float32)


def _below(positions: Floats, disparity: Indices) -> Floats:
    """Positions (N, 2) moved down by the disparity."""
    return positions + np.stack([np.zeros_like(disparity), disparity], axis=1).astype(np.float32)
