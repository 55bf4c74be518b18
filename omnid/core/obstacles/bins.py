"""The bins of the rays, half a disparity each, and what a pair shows of them on one plane of the floor."""

from __future__ import annotations

from typing import Final, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from omnid.core.obstacles import ray_kernels as kernels
from omnid.core.obstacles.column import ColumnEvidence, Columns
from omnid.core.obstacles.panoramas import DIRECTIONS, WorkingPair
from omnid.core.obstacles.ray_kernels import RayParameters

Array = NDArray[np.float64]
Floats = NDArray[np.float32]
Flags = NDArray[np.bool_]

BINS_PER_PX: Final = 2
STEP_ROWS: Final = 4.0  # of a step below its bin, which must be in view


class ShownBins(NamedTuple):
    """What a pair shows of the bins (N, DIRECTIONS), from near to far."""

    seen: Flags  # bins in view of both cameras
    floor: Floats  # log-likelihood ratios of the floor,
    levels: Floats  # (2, N, DIRECTIONS) of the floor to planes above and below it,
    surface: Floats  # of surfaces,
    fits: Floats  # and of those of them that fit best
    steps: Floats  # of grey across the bins
    greys: Floats
    far: Floats  # (DIRECTIONS,) largest step beyond the last bin

    def beyond(self, where: Flags, other: ShownBins) -> ShownBins:
        """Return what is shown of a floor that is another plane in some bins (N, DIRECTIONS)."""
        return ShownBins._make(
            np.where(where if mine.ndim > 1 else where[-1], theirs, mine)
            for mine, theirs in zip(self, other, strict=True)
        )


class Bins:
    """The bins of rays over a plane, from the nearest whose step is in view to the last that stereo compares."""

    def __init__(self, columns: Columns) -> None:
        numbers = np.arange(BINS_PER_PX * columns.bins)
        rows = _rows_of(columns, numbers)
        in_view = (rows[1] + STEP_ROWS < columns.last_row) & (numbers >= BINS_PER_PX * columns.first_bin)
        self.numbers = np.flatnonzero(in_view)[::-1]
        self.ranges_m = columns.at_1m / ((self.numbers + 0.5) / BINS_PER_PX)  # (N,)
        begins = (self.numbers + 1) / BINS_PER_PX
        # (N + 1,) range at which the bins begin, and the end of the last.
        self.ends_m = columns.at_1m / np.append(begins, begins[-1:] - 1 / BINS_PER_PX)


class PlaneView:
    """The bins on a plane of the floor."""

    def __init__(self, columns: Columns, bins: Bins, parameters: RayParameters) -> None:
        self.columns, self._bins, self._p = columns, bins, parameters
        # What lies beyond the bins shows the foot of what ends the floor.
        every = np.concatenate([bins.numbers, np.arange(1, BINS_PER_PX * columns.first_bin)[::-1]])
        rows = _rows_of(columns, every)  # (2, N + far ones)
        self._step_weights, self._grey_weights = _step_weights(rows, columns.panoramas.height)
        count = len(bins.numbers)
        self._rows = np.clip(np.rint(rows[:, :count]).astype(int), 0, columns.panoramas.height - 1)
        self._in_view = (rows[1, :count] + STEP_ROWS < columns.last_row)[:, None]

    @property
    def shows_floor(self) -> bool:
        """Whether any floor is in view."""
        return bool(self._of_bins(self.columns.panoramas.visible).any())

    def shown(self, pair: WorkingPair, evidence: ColumnEvidence) -> ShownBins:
        """Return what a pair shows, by its greys and its stereo evidence."""
        # 1. Steps of grey, and greys.
        count, numbers = len(self._bins.numbers), self._bins.numbers
        steps, greys = np.zeros((2, self._step_weights.shape[1], DIRECTIONS), np.float32)
        for weights, into in ((self._step_weights, steps), (self._grey_weights, greys)):
            for of_view, image in zip(weights, (pair.lower, pair.upper), strict=True):
                kernels.add_weighted_rows(of_view, image, into)
        far = np.abs(pooled(steps[count:])).max(axis=0, initial=0.0)
        # 2. Stereo. A surface that fits at a whole disparity is within half of one of it.
        of_bin = numbers // BINS_PER_PX
        of_surface = np.minimum((numbers + 1) // BINS_PER_PX, len(evidence.surface) - 1)
        stereo = evidence.floor[of_bin], evidence.level[:, of_bin], evidence.surface[of_surface]
        fits = self._surfaces(evidence.surface)[of_surface]
        return ShownBins(self._of_bins(pair.seen), *stereo, fits, steps[:count], greys[:count], far)

    def _of_bins(self, pixels: Flags) -> Flags:
        """Return the bins (N, DIRECTIONS) whose pixels (H, DIRECTIONS) of both views are set."""
        return np.asarray(pixels[self._rows[0]] & pixels[self._rows[1]] & self._in_view)

    def _surfaces(self, surface: Floats) -> Floats:
        """Return ratios (K, DIRECTIONS) of surfaces, where one fits best at least the weighted mean of neighbours."""
        p = self._p
        most = np.minimum(surface, p.surface_most)
        three = np.maximum(most, np.maximum(np.roll(most, 1, 0), np.roll(most, -1, 0)))
        half = int(p.wide_columns) // 2
        wide = cv2.blur(turned(three, half), (2 * half + 1, 1), borderType=cv2.BORDER_REPLICATE)[:, half:-half]
        is_best = wide >= np.maximum(np.roll(wide, 1, 0), np.roll(wide, -1, 0))
        return np.asarray(np.where(is_best, np.maximum(most, p.wide_weight * wide), most))


def pooled(steps: Floats) -> Floats:
    """Return steps (N, DIRECTIONS) as the mean of three directions."""
    return np.asarray((np.roll(steps, 1, axis=1) + 2 * steps + np.roll(steps, -1, axis=1)) / 4, np.float32)


def turned(values: Floats, count: int) -> Floats:
    """Return values (N, D) of a turn with so many directions repeated on either side."""
    return np.concatenate([values[:, -count:], values, values[:, :count]], axis=1)


def _rows_of(columns: Columns, numbers: NDArray[np.intp]) -> Array:
    """Return the rows (2, N) of the middles of bins in both views."""
    middle = (numbers + 0.5) / BINS_PER_PX
    lower = columns.panoramas.row0 + 0.5 + middle / columns.floor_slope
    return np.stack([lower, lower + middle])


def _step_weights(rows: Array, height: int) -> tuple[Floats, Floats]:
    """Return the weights (2, N, H) of the rows of both views for steps of grey at rows (2, N), and for greys there.

    A step is the difference of the means of 2.6 rows on either side, less the trend of the rows beyond: a shading is no
    edge.
    """
    edges = np.arange(height)

    def mean(first: float, end: float) -> Array:
        low, high = (np.clip(rows[..., None] + at, 0, height - 1) for at in (first, end))
        part = np.clip(np.minimum(high, edges + 1) - np.maximum(low, edges), 0, None)
        return np.asarray(part / np.maximum(part.sum(axis=-1, keepdims=True), 1e-6))

    above, below, before, beyond = mean(-3.6, -1.0), mean(1.0, 3.6), mean(-8.0, -3.6), mean(3.6, 8.0)
    step = above - below - 0.575 * (before - above + below - beyond)
    return (step / 2).astype(np.float32), (mean(-1.1, 1.1) / 2).astype(np.float32)
