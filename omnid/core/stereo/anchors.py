"""Enhanced SAD: choose among several candidates by lines to anchors (Dang et al. 2012, section III.B).

A point with one candidate is matched at once and becomes an anchor. For a point with several candidates, the line
difference is added to each candidate's SAD: the difference between the grey levels along the line from the point to an
anchor in the lower panorama and along the line from the candidate to the anchor's match in the upper panorama. The
candidate with the lowest total is the match.

On a wall of identical bricks anchors are rare, so they are propagated. Each cell of a coarse grid holds one anchor. A
cell without one decides a point of its own by the lines to the anchors of the neighbouring cells, which are longer than
a brick, and that point becomes the cell's anchor; this repeats outwards. Every other point is then decided by the line
to the nearest anchor of its own or a neighbouring cell.
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

CELL_PX = 32  # side of a cell, because the courses of most brick walls are lower
# Grey levels by which the second candidate of a point must be worse; twice as many for a new anchor, because errors
# propagate. By trial on development seeds.
CLEAR_MARGIN = 1.0
CHUNK_LINES = 4_000  # lines sampled at a time, so that their pixels stay in the processor's cache
NO_ANCHOR = -1  # because indices are never negative


@dataclass(frozen=True, slots=True)
class Candidates:
    """Rows (M,), one per candidate of each point: index of the point, disparity [px], mean difference [grey levels]."""

    point: Indices
    disparity: Indices
    difference: Array

    def of(self, points: Flags) -> Candidates:
        """Return the rows of the points that are flagged (N,)."""
        rows = np.flatnonzero(points[self.point])
        return Candidates(self.point[rows], self.disparity[rows], self.difference[rows])

    def best(self, total: Array, count: int) -> tuple[Indices, Array]:
        """Return each point's row with the lowest total, and the margin to its second one (count,); 0 without rows.

        total: (M,) one per row. The margin of a point with a single candidate is infinite.
        """
        lowest, second = np.full((2, count), np.inf, np.float32)
        np.minimum.at(lowest, self.point, total)
        winners = np.flatnonzero(total == lowest[self.point])
        row = np.zeros(count, np.intp)
        row[self.point[winners]] = winners
        losers = np.flatnonzero(row[self.point] != np.arange(len(total)))
        np.minimum.at(second, self.point[losers], total[losers])
        return row, np.where(np.isfinite(lowest), second, 0) - np.where(np.isfinite(lowest), lowest, 0)


class AnchorPropagation:
    """Points (N,) of a pair of panoramas (H, W) with their disparities, and the grid of anchors among them."""

    def __init__(self, images: tuple[Image, Image], pixels: Indices, disparity: Indices) -> None:
        """images: lower and upper panorama; pixels: flat indices (N,) into the lower one."""
        height, width = images[0].shape
        self.disparity = disparity.copy()
        self._images = images
        rows, columns = np.divmod(pixels, width)
        self._column, self._row = columns.astype(np.float32), rows.astype(np.float32)
        # A ring of empty cells surrounds the image, so that every cell has eight neighbours.
        cells_per_row = width // CELL_PX + 3
        self._cell = (rows // CELL_PX + 1) * cells_per_row + columns // CELL_PX + 1
        self._neighbourhood = (np.arange(-1, 2)[:, None] * cells_per_row + np.arange(-1, 2)).reshape(-1)
        self._anchor = np.full((height // CELL_PX + 3) * cells_per_row, NO_ANCHOR)

    def propagate(self, sure: Flags, candidates: Candidates) -> Flags:
        """Choose the disparity of each point with candidates; return flags (N,) of points with a clear margin.

        sure: (N,) points that may be anchors; their disparities must be right. A point takes its lowest total even
        where the margin is small; one without an anchor in its neighbourhood keeps its disparity.
        """
        # 1. Each cell's sure point nearest to the middle is its anchor.
        self._anchor = self._central_points(np.flatnonzero(sure))
        # 2. Anchors spread to the cells without one.
        ambiguous = np.zeros(len(sure), bool)
        ambiguous[candidates.point] = True
        new_anchors = self._grow_anchors(np.flatnonzero(ambiguous), candidates)
        # 3. All other points are decided by the line to their nearest anchor.
        anchor = self._nearest_anchors(ambiguous & ~new_anchors)
        decided = anchor != NO_ANCHOR
        rows = candidates.of(decided)
        along = self._line_differences(rows.point, rows.disparity, anchor[rows.point])
        best, margin = rows.best(rows.difference + along, len(sure))
        self.disparity[decided] = rows.disparity[best[decided]]
        return np.asarray(new_anchors | (margin > CLEAR_MARGIN))

    def _central_points(self, points: Indices) -> Indices:
        """Return, per cell, the one of the points that is nearest to its middle, or NO_ANCHOR."""
        x, y = self._column[points] % CELL_PX, self._row[points] % CELL_PX
        off = np.abs(x - CELL_PX / 2) + np.abs(y - CELL_PX / 2)
        nearest_last = points[np.argsort(-off, kind="stable")]
        chosen = np.full(len(self._anchor), NO_ANCHOR)
        chosen[self._cell[nearest_last]] = nearest_last
        return chosen

    def _grow_anchors(self, ambiguous: Indices, candidates: Candidates) -> Flags:
        """Make an ambiguous point the anchor of each cell without one, from neighbour to neighbour; return them (N,).

        A cell whose point could not be decided is tried again when more of its neighbours have an anchor.
        """
        count = len(self.disparity)
        new, seed = np.zeros(count, bool), np.zeros(count, bool)
        central = self._central_points(ambiguous)
        seed[central[(self._anchor == NO_ANCHOR) & (central != NO_ANCHOR)]] = True
        candidates, tried_with = candidates.of(seed), np.zeros(count, np.intp)
        while True:
            neighbours = np.count_nonzero(self._anchors_around(np.flatnonzero(seed)) != NO_ANCHOR, axis=1)
            active = np.zeros(count, bool)
            active[np.flatnonzero(seed)[neighbours > tried_with[seed]]] = True
            tried_with[seed] = neighbours
            if not active.any():
                return new
            decided = self._decide_by_all_anchors(candidates.of(active)) & active
            self._anchor[self._cell[decided]] = np.flatnonzero(decided)
            new, seed = new | decided, seed & ~decided

    def _decide_by_all_anchors(self, rows: Candidates) -> Flags:
        """Decide points by the mean over the lines to all anchors around; return those (N,) with a large margin."""
        anchors = self._anchors_around(rows.point)
        row, k = np.nonzero(anchors != NO_ANCHOR)
        along = self._line_differences(rows.point[row], rows.disparity[row], anchors[row, k], cells=2)
        mean = np.bincount(row, along, len(anchors)) / np.count_nonzero(anchors != NO_ANCHOR, axis=1)
        best, margin = rows.best(rows.difference + mean.astype(np.float32), len(self.disparity))
        decided = margin > 2 * CLEAR_MARGIN
        self.disparity[decided] = rows.disparity[best[decided]]
        return np.asarray(decided)

    def _anchors_around(self, points: Indices) -> Indices:
        """Return the anchors (N, 9) of the cells of points and of their neighbours, NO_ANCHOR where there is none."""
        return np.asarray(self._anchor[self._cell[points][:, None] + self._neighbourhood])

    def _nearest_anchors(self, points: Flags) -> Indices:
        """Return the nearest anchor (N,) around each of the points flagged; NO_ANCHOR for the others."""
        chosen = np.full(len(points), NO_ANCHOR)
        anchors = self._anchors_around(np.flatnonzero(points))
        dx, dy = (at[anchors] - at[points][:, None] for at in (self._column, self._row))
        distance = np.where(anchors == NO_ANCHOR, np.inf, dx * dx + dy * dy)
        chosen[points] = np.take_along_axis(anchors, distance.argmin(axis=1)[:, None], axis=1)[:, 0]
        return chosen

    def _line_differences(self, point: Indices, disparity: Indices, anchor: Indices, cells: int = 1) -> Array:
        """Return the mean absolute differences (M,) of grey levels along lines in the lower and the upper panorama.

        The lines lead from points at disparities to anchors that are so many cells away, and are sampled at equal
        fractions of their lengths.
        """
        start = np.stack([self._column[point], self._row[point], disparity.astype(np.float32)])
        end = np.stack([self._column[anchor], self._row[anchor], self.disparity[anchor].astype(np.float32)])
        samples, difference = cells * CELL_PX // 4, np.empty(len(point), np.float32)  # every fourth pixel
        along = (np.arange(samples, dtype=np.float32) + 0.5) / samples
        for first in range(0, len(difference), CHUNK_LINES):
            part = slice(first, first + CHUNK_LINES)
            columns, rows, disparities = start[:, part, None] + along * (end - start)[:, part, None]
            lower, upper = (
                cv2.remap(image, columns, at, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
                for image, at in zip(self._images, (rows, rows + disparities), strict=True)
            )
            difference[part] = cv2.reduce(cv2.absdiff(lower, upper), 1, cv2.REDUCE_AVG, dtype=cv2.CV_32F)[:, 0]
        return difference
