"""The enhanced SAD: which of several candidates is the match (Dang et al. 2012, section III.B).

A point with one candidate is matched at once and becomes an anchor. For a point with several, each candidate's
difference grows by that of the grey levels along the line from the point to an anchor in the lower panorama and along
the line from the candidate to the anchor's match in the upper one. The lowest total wins.

On a wall of identical bricks anchors are rare, so they spread: each cell of a coarse grid holds one, and a cell without
one settles a point of its own by the lines to those of the cells around it, which are long enough to leave a brick;
and so on outwards. Every other point is then settled by the line to the nearest anchor of its cell and those around.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

Image = NDArray[np.uint8]
Array = NDArray[np.float32]
Flags = NDArray[np.bool_]
Indices = NDArray[np.intp]

CELL_PX = 32
ROUNDS = 64  # cells the anchors spread over at most
LONG_SAMPLES, SHORT_SAMPLES = 16, 8  # on a line between cells, on one to the nearest anchor
DECISIVE, CLEAR = 2.0, 1.0  # grey levels by which the second best total must be worse: of a new anchor, of a point
CHUNK = 4_000  # lines sampled at a time: their pixels stay in the cache
NOBODY = -1


@dataclass(frozen=True, slots=True)
class Candidates:
    """Rows (M,), one for each candidate of each point: the point's index, a disparity [px], its mean difference."""

    point: Indices
    disparity: Indices
    difference: Array

    def of(self, points: Flags) -> Candidates:
        """The rows of the points that are flagged (N,)."""
        rows = np.flatnonzero(points[self.point])
        return Candidates(self.point[rows], self.disparity[rows], self.difference[rows])

    def best(self, total: Array, count: int) -> tuple[Indices, Array]:
        """Row (count,) of the lowest total (M,) of each point, and how much worse the second one is; 0 without any."""
        lowest, second = np.full((2, count), np.inf, np.float32)
        np.minimum.at(lowest, self.point, total)
        won = np.flatnonzero(total == lowest[self.point])
        row = np.zeros(count, np.intp)
        row[self.point[won]] = won
        lost = np.flatnonzero(row[self.point] != np.arange(len(total)))
        np.minimum.at(second, self.point[lost], total[lost])
        return row, np.where(np.isfinite(lowest), second, 0) - np.where(np.isfinite(lowest), lowest, 0)


class AnchorPropagation:
    """The points of a pair of panoramas (H, W), their disparities (N,), and a grid of anchors among them."""

    def __init__(self, images: tuple[Image, Image], pixels: Indices, disparity: Indices) -> None:
        height, width = images[0].shape
        self.disparity = disparity.copy()
        self._images = images
        rows, columns = np.divmod(pixels, width)
        self._column, self._row = columns.astype(np.float32), rows.astype(np.float32)
        across = width // CELL_PX + 3  # with a ring of empty cells about the image
        self._cell = (rows // CELL_PX + 1) * across + columns // CELL_PX + 1
        self._around = (np.arange(-1, 2)[:, None] * across + np.arange(-1, 2)).reshape(-1)
        self._anchor = np.full((height // CELL_PX + 3) * across, NOBODY)

    def settle(self, sure: Flags, candidates: Candidates) -> Flags:
        """Sets the disparities of points with candidates from those that are sure; which (N,) clearly beat the others.

        sure: (N,) flags of what may be an anchor; their disparities must be right. A point takes its lowest total even
        where that is not clear; one without an anchor around keeps its disparity.
        """
        self._anchor = self._central(np.flatnonzero(sure))
        several = np.zeros(len(sure), bool)
        several[candidates.point] = True
        spread = self._spread(np.flatnonzero(several), candidates)
        anchor = self._nearest(several & ~spread)
        rows = candidates.of(anchor != NOBODY)
        along = self._differences(rows.point, rows.disparity, anchor[rows.point], SHORT_SAMPLES)
        best, margin = rows.best(rows.difference + along, len(sure))
        self._decide(rows, best, anchor != NOBODY)
        return np.asarray(spread | (margin > CLEAR))

    def _central(self, points: Indices) -> Indices:
        """For each cell the one of the points that is nearest to its middle, or NOBODY."""
        x, y = self._column[points] % CELL_PX, self._row[points] % CELL_PX
        off = np.abs(x - CELL_PX / 2) + np.abs(y - CELL_PX / 2)
        nearest_last = points[np.argsort(-off, kind="stable")]
        chosen = np.full(len(self._anchor), NOBODY)
        chosen[self._cell[nearest_last]] = nearest_last
        return chosen

    def _spread(self, several: Indices, candidates: Candidates) -> Flags:
        """Makes one of the points an anchor in each cell without one, from its neighbours outwards; which (N,).

        A cell whose point is not decided asks again when more of its neighbours have an anchor.
        """
        count = len(self.disparity)
        new, seed = np.zeros(count, bool), np.zeros(count, bool)
        central = self._central(several)
        seed[central[(self._anchor == NOBODY) & (central != NOBODY)]] = True
        candidates, seen = candidates.of(seed), np.zeros(count, np.intp)
        for _ in range(ROUNDS):
            neighbours = np.count_nonzero(self._near(np.flatnonzero(seed)) != NOBODY, axis=1)
            asked = np.zeros(count, bool)
            asked[np.flatnonzero(seed)[neighbours > seen[seed]]] = True
            seen[seed] = neighbours
            if not asked.any():
                break
            decided = self._ask_all_around(candidates.of(asked)) & asked
            self._anchor[self._cell[decided]] = np.flatnonzero(decided)
            new, seed = new | decided, seed & ~decided
        return new

    def _ask_all_around(self, rows: Candidates) -> Flags:
        """Settles points by the mean over the lines to all anchors around; which (N,) have a decisive total."""
        anchors = self._near(rows.point)
        row, k = np.nonzero(anchors != NOBODY)
        along = self._differences(rows.point[row], rows.disparity[row], anchors[row, k], LONG_SAMPLES)
        mean = np.bincount(row, along, len(anchors)) / np.count_nonzero(anchors != NOBODY, axis=1)
        best, margin = rows.best(rows.difference + mean.astype(np.float32), len(self.disparity))
        decided = margin > DECISIVE
        self._decide(rows, best, decided)
        return np.asarray(decided)

    def _near(self, points: Indices) -> Indices:
        """The anchors (N, 9) in the cells of points and around them, NOBODY where there is none."""
        return np.asarray(self._anchor[self._cell[points][:, None] + self._around])

    def _nearest(self, points: Flags) -> Indices:
        """The nearest anchor (N,) around each of the points flagged; NOBODY for the others."""
        chosen = np.full(len(points), NOBODY)
        anchors = self._near(np.flatnonzero(points))
        dx, dy = (at[anchors] - at[points][:, None] for at in (self._column, self._row))
        distance = np.where(anchors == NOBODY, np.inf, dx * dx + dy * dy)
        chosen[points] = np.take_along_axis(anchors, distance.argmin(axis=1)[:, None], axis=1)[:, 0]
        return chosen

    def _differences(self, point: Indices, disparity: Indices, anchor: Indices, samples: int) -> Array:
        """The line differences (M,) of points at disparities against anchors."""
        start = np.stack([self._column[point], self._row[point], disparity.astype(np.float32)])
        end = np.stack([self._column[anchor], self._row[anchor], self.disparity[anchor].astype(np.float32)])
        return line_difference(self._images, start, end, samples)

    def _decide(self, rows: Candidates, best: Indices, decided: Flags) -> None:
        self.disparity[decided] = rows.disparity[best[decided]]


def line_difference(images: tuple[Image, Image], start: Array, end: Array, samples: int) -> Array:
    """Mean absolute difference (M,) of grey levels along lines in the lower and in the upper panorama.

    start, end: (3, M) column and row in the lower panorama, and disparity: how much lower in the upper one. Sampled at
    equal fractions of the lengths.
    """
    difference = np.empty(start.shape[1], np.float32)
    along = (np.arange(samples, dtype=np.float32) + 0.5) / samples
    for first in range(0, len(difference), CHUNK):
        part = slice(first, first + CHUNK)
        columns, rows, disparities = start[:, part, None] + along * (end - start)[:, part, None]
        lower, upper = (cv2.remap(image, columns, at, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
                        for image, at in zip(images, (rows, rows + disparities), strict=True))
        difference[part] = cv2.reduce(cv2.absdiff(lower, upper), 1, cv2.REDUCE_AVG, dtype=cv2.CV_32F)[:, 0]
    return difference
