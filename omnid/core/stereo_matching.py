"""Vertical matching of two panoramas: edges, SAD, disambiguation, left-right check, sub-pixel."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from omnid.core.disambiguation import line_difference, nearest_anchor
from omnid.core.edges import edge_pixels, smooth
from omnid.core.sad import NEVER, Costs, Indices, SadVolume, local_minima, subpixel

Image = NDArray[np.uint8]


@dataclass(frozen=True, slots=True)
class Matching:
    """How to match: the SAD's window and threshold, the edges, and what to do with several candidates."""

    enhanced: bool = True  # section III.B; else the lowest SAD wins
    window_px: int = 9
    disparities: int = 64
    max_difference: float = 12.0  # mean grey level difference in the window that is still a match
    rival: float = 1.25  # a candidate is one whose SAD is at most this times the best one's, plus one grey level
    edge_threshold: int = 40
    max_points: int = 30_000
    sigma_px: float = 0.8
    max_candidates: int = 4


class Matcher:
    """Finds, for edges of the lower panorama, the rows in the upper one; keeps its buffers between pairs."""

    def __init__(self, shape: tuple[int, int], matching: Matching) -> None:
        self.matching = matching
        self._volume = SadVolume(shape, matching.disparities, matching.window_px)

    def match(self, lower: Image, upper: Image, valid: NDArray[np.bool_]) -> tuple[Indices, NDArray[np.float32]]:
        """Flat indices (N,) of the matched pixels of the lower panorama and their disparities (N,) > 0 [px].

        lower, upper (H, W) uint8, their edges repeated or wrapped by the caller; valid (H, W): pixels to match.
        """
        how = self.matching
        lower, upper = smooth(lower, how.sigma_px), smooth(upper, how.sigma_px)
        pixels = edge_pixels(lower, valid, how.edge_threshold, how.max_points)
        self._volume.fill(lower, upper)
        costs = self._volume.at(pixels)
        minima = local_minima(costs, self._limit(costs))
        disparity = self._choose(lower, upper, pixels, costs, minima)
        kept = minima.any(axis=0) & (np.abs(self._volume.seen_from_upper(pixels, disparity) - disparity) <= 1)
        return pixels[kept], subpixel(costs[:, kept], disparity[kept])

    def _limit(self, costs: Costs) -> Costs:
        """The largest SAD (N,) that makes a candidate: near the best one, and never above the threshold."""
        area = self.matching.window_px**2
        near = costs.min(axis=0) * self.matching.rival + area
        return np.asarray(np.minimum(near, self.matching.max_difference * area), np.uint16)

    def _choose(self, lower: Image, upper: Image, pixels: Indices, costs: Costs, minima: NDArray[np.bool_]) -> Indices:
        """The disparity (N,) of the best candidate of each pixel."""
        best = np.where(minima, costs, NEVER).argmin(axis=0)
        several = np.flatnonzero(minima.sum(axis=0) > 1)
        anchors = np.flatnonzero(minima.sum(axis=0) == 1)
        if self.matching.enhanced and len(several) and len(anchors):
            best[several] = self._by_anchor(lower, upper, (pixels, best, anchors, several), costs, minima)
        return best

    def _by_anchor(self, lower: Image, upper: Image, chosen: tuple[Indices, Indices, Indices, Indices], costs: Costs,
                   minima: NDArray[np.bool_]) -> Indices:
        """The disparities of the points with several candidates, by the lines to their nearest anchors."""
        pixels, best, anchors, several = chosen
        rank, cost = _lowest(costs[:, several], minima[:, several], self.matching.max_candidates)
        anchor = anchors[nearest_anchor(lower.shape, pixels[anchors], pixels[several])]
        k, point = np.nonzero(cost < NEVER)
        start = _positions(pixels[several[point]], lower.shape[1])
        end = _positions(pixels[anchor[point]], lower.shape[1])
        shifted = (_below(start, rank[k, point]), _below(end, best[anchor[point]]))
        total = np.full(cost.shape, np.inf, np.float32)
        total[k, point] = cost[k, point] / self.matching.window_px**2
        total[k, point] += line_difference(lower, upper, (start, end, *shifted))
        return np.take_along_axis(rank, total.argmin(axis=0)[None], axis=0)[0]


def _lowest(costs: Costs, minima: NDArray[np.bool_], most: int) -> tuple[Indices, Costs]:
    """The disparities (K, N) of the K lowest minima of costs (D, N) and their costs; NEVER where there are fewer."""
    masked = np.where(minima, costs, NEVER)
    rank = np.argsort(masked, axis=0)[:most]
    return rank, np.take_along_axis(masked, rank, axis=0)


def _positions(pixels: Indices, width: int) -> NDArray[np.float32]:
    """(column, row) (N, 2) of flat indices."""
    return np.stack([pixels % width, pixels // width], axis=1).astype(np.float32)


def _below(positions: NDArray[np.float32], disparity: Indices) -> NDArray[np.float32]:
    """Positions (N, 2) moved down by the disparity."""
    return positions + np.stack([np.zeros_like(disparity), disparity], axis=1).astype(np.float32)
