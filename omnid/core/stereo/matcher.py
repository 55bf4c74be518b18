"""Stereo matching along the columns of two panoramas, for the edges of the lower one: three methods.

`sad` takes the lowest SAD along the column (Dang et al. 2012, eq. (1)); `enhanced` chooses among several candidates by
lines to anchors (section III.B); `semiglobal`, the default, searches near a semi-global prior only.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Literal, TypeVar

import cv2
import numpy as np
from numpy.typing import NDArray

from omnid.core.stereo.anchors import AnchorPropagation, Candidates
from omnid.core.stereo.semiglobal import (
    LEFT_RIGHT_PX,
    NO_MATCH,
    ColumnShift,
    Costs,
    Flags,
    Floats,
    Image,
    Indices,
    SemiGlobalSearch,
    local_minima,
    sad,
    subpixel,
)

Scalar = TypeVar("Scalar", bound=np.generic)
Matches = tuple[Indices, Floats]  # flat indices (N,) into the lower panorama, disparities (N,) > 0 [px]

RESPONSE_SCALE = 0.5  # A 3x3 Sobel of 8-bit images reaches 1020; half of that, clipped at 255, is kept in 8 bits.
# Sobel response that noise of one grey level reaches in one pixel of a hundred; by trial on development seeds.
EDGE_NOISE = 6.0


@dataclass(frozen=True, slots=True)
class MatchingSettings:
    """Settings of the matching: method, window and threshold of the SAD, choice of edges."""

    method: Annotated[
        Literal["auto", "sad", "enhanced", "semiglobal"],
        "chooses among several candidates; auto: enhanced for the paper's odometry, else semiglobal",
    ] = "auto"
    window_px: int = 9  # side of the matching window, px; odd
    disparities: int = 128  # largest number of disparities searched, px; fewer where stereo.min_range_m needs fewer
    max_difference: float = 12.0  # largest mean difference of grey levels in the window of a match
    # enhanced: a further candidate has a SAD of at most this times the lowest one, plus runner_up_difference
    runner_up_ratio: float = 2.0
    # enhanced: in mean grey levels of the window; a point without a further candidate is an anchor
    runner_up_difference: float = 4.0
    edge_threshold: int = 40  # least Sobel response of an edge, 8 per grey level and pixel
    max_points: int = 30_000  # largest number of edge pixels matched in a pair
    sigma_px: float = 0.8  # standard deviation of the Gaussian blur before matching, px; 0: none
    max_candidates: int = 8  # enhanced: largest number of candidates compared for one pixel

    @property
    def max_cost(self) -> int:
        """Largest SAD of a match."""
        return int(self.max_difference * self.window_px**2)


def smooth(image: Image, sigma_px: float) -> Image:
    """Return the image blurred by a Gaussian against the noise of single pixels; sigma 0 returns it unchanged."""
    return np.asarray(cv2.GaussianBlur(image, (0, 0), sigma_px), np.uint8) if sigma_px > 0 else image


def edge_pixels(smoothed: Image, valid: Flags, threshold: int, limit: int) -> Indices:
    """Return flat indices, ascending, of pixels where the Sobel response along the column is a maximum.

    Only a change along the column distinguishes a match from its neighbours there, so only that is measured, and only
    the crest of each edge is kept. threshold: least response, in units of the 3x3 Sobel (8 per grey level and pixel).
    If more than limit remain, every n-th is taken, evenly over the image.
    """
    response = cv2.convertScaleAbs(cv2.Sobel(smoothed, cv2.CV_16S, 0, 1), alpha=RESPONSE_SCALE)
    least = int(threshold * RESPONSE_SCALE)
    crest = (response[1:-1] >= response[:-2]) & (response[1:-1] > response[2:]) & (response[1:-1] > least)
    chosen = np.flatnonzero(crest & valid[1:-1]) + smoothed.shape[1]
    return np.asarray(chosen[:: max(1, -(-len(chosen) // limit))])


class Matcher:
    """Matches edges of the lower panorama in the upper one; keeps its buffers between pairs."""

    def __init__(self, shape: tuple[int, int], matching: MatchingSettings) -> None:
        self._matching, m = matching, matching
        self._search: SemiGlobalSearch | ColumnSearch
        if m.method in ("auto", "semiglobal"):
            self._search = SemiGlobalSearch(shape, m.disparities, m.window_px, m.max_cost)
        else:
            self._search = ColumnSearch(shape, matching)

    def match(
        self, lower: Image, upper: Image, valid: Flags, noise_grey: float = 0.0, column_shift: ColumnShift | None = None
    ) -> Matches:
        """Return the matches of panoramas (H, W) uint8, padded at the seam, among the valid pixels (H, W).

        noise_grey: standard deviation of the noise; where it is large, the threshold of the edges follows it.
        column_shift: of a pair that is not synchronised; the default method searches there.
        """
        m = self._matching
        lower, upper = smooth(lower, m.sigma_px), smooth(upper, m.sigma_px)
        least = max(m.edge_threshold, round(EDGE_NOISE * noise_grey))
        pixels = edge_pixels(lower, valid, least, m.max_points)
        return self._search.search(lower, upper, pixels, column_shift)


class ColumnSearch:
    """SAD along the whole column with the left-right check: the lowest one, or one chosen among several candidates.

    The former is eq. (1) of Dang et al. 2012, the latter section III.B.
    """

    def __init__(self, shape: tuple[int, int], matching: MatchingSettings) -> None:
        self._matching = matching
        # SAD of every pixel of the lower panorama and the pixel d rows below it in the upper one, d = 0 .. D-1.
        self._planes = np.full((min(matching.disparities, shape[0]), *shape), NO_MATCH, np.uint16)

    def search(self, lower: Image, upper: Image, pixels: Indices, column_shift: ColumnShift | None) -> Matches:
        """Return the pixels whose match the upper panorama confirms; a column shift is ignored.

        Where the lines to anchors decided clearly, the match need only be one of the candidates of the upper pixel:
        repeated bricks mislead the SAD from either side.
        """
        for d, plane in enumerate(self._planes):
            rows = len(lower) - d
            plane[:rows] = sad(lower[:rows], upper[d:], self._matching.window_px)
        costs = np.array([np.take(plane.reshape(-1), pixels, mode="clip") for plane in self._planes])
        disparity, lowest = costs.argmin(axis=0), costs.min(axis=0)
        if self._matching.method == "sad":
            kept = _at(local_minima(costs, self._matching.max_cost), disparity)
            kept &= self._is_best_from_upper(pixels, disparity)
            return pixels[kept], subpixel(costs, disparity)[kept]
        # 1. Points with one candidate are matched by the lowest SAD and become anchors.
        minima = local_minima(costs, self._candidate_limit(lowest))
        count = np.count_nonzero(minima, axis=0)
        kept, ambiguous = (count == 1) & _at(minima, disparity), count > 1
        kept[kept] = self._is_best_from_upper(pixels[kept], disparity[kept])
        # 2. Points with several candidates are decided by lines to anchors.
        propagation = AnchorPropagation((lower, upper), pixels, disparity)
        clear = propagation.propagate(kept, self._candidates(costs, minima, count))
        disparity = propagation.disparity
        # 3. The upper panorama confirms: strictly where the margin to the second candidate was small.
        unclear = ambiguous & ~clear & _at(minima, disparity)
        _, lowest = self._best_from_upper(pixels[clear], disparity[clear])
        kept[clear] = _at(costs, disparity)[clear] <= self._candidate_limit(lowest)
        kept[unclear] = self._is_best_from_upper(pixels[unclear], disparity[unclear])
        return pixels[kept], subpixel(costs, disparity)[kept]

    def _candidate_limit(self, lowest: Costs) -> Costs:
        """Return the largest SAD (N,) of a candidate: near the lowest one, and never above the threshold."""
        m, area = self._matching, self._matching.window_px**2
        near = lowest * m.runner_up_ratio + m.runner_up_difference * area
        return np.asarray(np.minimum(near, m.max_difference * area), np.uint16)

    def _is_best_from_upper(self, pixels: Indices, disparity: Indices) -> Flags:
        """Return the matches (N,) that are also the best ones of their upper pixels, within LEFT_RIGHT_PX."""
        choice, _ = self._best_from_upper(pixels, disparity)
        return np.asarray(np.abs(choice - disparity) <= LEFT_RIGHT_PX)

    def _best_from_upper(self, pixels: Indices, disparity: Indices) -> tuple[Indices, Costs]:
        """Return the best disparities (N,) of the upper panorama's pixels, and their costs (N,): the left-right check.

        The upper pixels are given by pixels (N,) of the lower panorama and their disparities (N,).
        """
        width = self._planes.shape[2]
        upper = pixels + disparity * width
        best = np.full(len(pixels), NO_MATCH, np.uint16)
        choice = np.zeros(len(pixels), np.intp)
        for d, plane in enumerate(self._planes):
            cost = np.take(plane.reshape(-1), np.maximum(upper - d * width, 0), mode="clip")
            better = (cost < best) & (upper >= d * width)
            best[better], choice[better] = cost[better], d
        return choice, best

    def _candidates(self, costs: Costs, minima: Flags, count: Indices) -> Candidates:
        """Return the minima of the points with more than one; of too many the lowest. Overwrites minima."""
        limit = self._matching.max_candidates
        if (many := np.flatnonzero(count > limit)).size:
            masked = np.where(minima[:, many], costs[:, many], NO_MATCH)
            minima[:, many] &= masked <= np.partition(masked, limit - 1, axis=0)[limit - 1]
        disparity, point = np.divmod(np.flatnonzero(minima), len(count))
        rows = np.flatnonzero(count[point] > 1)
        disparity, point = disparity[rows], point[rows]
        difference = costs[disparity, point] / np.float32(self._matching.window_px**2)
        return Candidates(point, disparity, difference.astype(np.float32))


def _at(values: NDArray[Scalar], disparity: Indices) -> NDArray[Scalar]:
    """Return the values (N,) of values (D, N) at disparities (N,)."""
    return values[disparity, np.arange(len(disparity))]
