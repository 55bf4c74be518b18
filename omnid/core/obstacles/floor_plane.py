"""Floor between the edges that stereo needs: the upper panorama, moved as the plane predicts, against the lower.

A plane-sweep test (Collins 1996, "A space-sweep approach to true multi-image matching") of one plane: windows whose
gradient along the column, which is what disparity shifts, correlates at the plane and less at other disparities. Tiles
of slightly different shade are enough. A plain wall shows no gradient and is no floor; windows that reach over the foot
of a wall are, so the end of the floor is known to END_M.
"""

from __future__ import annotations

import math
from typing import Final

import cv2
import numpy as np
from numpy.typing import NDArray

from calib import se3
from calib.panorama import Cylinder
from omnid.core.mapping.range_scan import SECTORS
from omnid.core.types.panorama import PaddedPanorama

Array = NDArray[np.float64]
Greys = NDArray[np.float32]
Flags = NDArray[np.bool_]

FARTHEST_M: Final = 2.6  # farther away, a window is longer than END_M
BIN_M: Final = 0.1
BINS: Final = math.ceil(FARTHEST_M / BIN_M)
END_M: Final = 0.45  # of the floor before textured walls, in recorded drives: 0.4 m (p90), 0.7 m (most)
COLUMN_STEP: Final = 2  # of the columns that are compared
BLUR_COLUMNS: Final = 7
WINDOW: Final = (7, 9)  # columns that are compared, rows
MARGIN_ROWS: Final = 8  # for windows and filters
OTHER_ROWS: Final = (-6, -3, 3, 6, 9, 12, 15, 18, 22, 26)  # shifts from the plane: what stands up has more disparity
LEAST_CORRELATION: Final = 0.7
CLEARER: Final = 0.15  # than at other shifts
GRADIENT_PER_NOISE: Final = 0.12  # of the noise of a pixel: that of the filtered gradient
LEAST_SHARE: Final = 0.3  # of the pixels of a bin and the bins beside it
GAP_BINS: Final = 2  # without floor that are passed over


class FloorPlane:
    """Compares pairs with the plane of the floor; everything that only depends on the rig is computed once."""

    def __init__(self, cylinder: Cylinder, T_rect_floor: Array, baseline_m: float, visible: Flags) -> None:
        """T_rect_floor (4, 4): from the level frame of the base, with the floor at z = 0, to the rectified frame.

        visible (H, W): pixels that show the world.
        """
        T_floor_rect = se3.inverse(T_rect_floor)
        columns = np.arange(0, cylinder.width, COLUMN_STEP)
        rows = np.arange(cylinder.height)
        grid = np.stack(np.meshgrid(columns, rows), axis=-1).reshape(-1, 2).astype(float)
        rays = cylinder.rays(grid)
        fall = rays @ T_floor_rect[2, :3]
        with np.errstate(divide="ignore"):
            r = np.where(fall < 0, -T_floor_rect[2, 3] / fall, np.inf)  # from the axis of the cylinder
        upper = grid[:, 1] + cylinder.focal_px * baseline_m / r
        with np.errstate(invalid="ignore"):
            place = se3.apply(T_floor_rect, rays * np.where(np.isfinite(r), r, np.nan)[:, None])
        distance = np.hypot(place[:, 0], place[:, 1])
        below = np.clip(np.rint(upper), 0, cylinder.height - 1).astype(np.intp)
        at = grid.astype(np.intp)
        usable = (distance < FARTHEST_M) & (upper < cylinder.height - 1)
        usable &= visible[at[:, 1], at[:, 0]] & visible[below, at[:, 0]]
        shape = (len(rows), len(columns))
        found = np.flatnonzero(usable.reshape(shape).any(axis=1))
        first, last = (int(found[0]), int(found[-1])) if len(found) else (0, -1)
        self._rows = slice(max(0, first - MARGIN_ROWS), min(cylinder.height, last + 1 + MARGIN_ROWS))
        kept = usable.reshape(shape)[self._rows]
        sector = np.floor((np.arctan2(place[:, 1], place[:, 0]) + math.pi) * (SECTORS / (2 * math.pi)))
        with np.errstate(invalid="ignore"):
            index = (sector % SECTORS) * BINS + np.floor(distance / BIN_M)
        self._kept, self._index = kept, index.reshape(shape)[self._rows][kept].astype(np.intp)
        self._total = _beside(np.bincount(self._index, minlength=SECTORS * BINS).reshape(SECTORS, BINS))
        self._columns = columns
        self._upper_rows = upper.reshape(shape)[self._rows].astype(np.float32)

    def free_m(self, lower: PaddedPanorama, upper: PaddedPanorama) -> Array:
        """Return how far (SECTORS,) the floor is seen without a gap from the nearest that both cameras see, 0: not."""
        if not len(self._index):
            return np.zeros(SECTORS)
        is_floor = self._floor(lower, upper)[self._kept]
        counts = np.bincount(self._index, is_floor, SECTORS * BINS).reshape(SECTORS, BINS)
        seen = (self._total > 0) & (_beside(counts) >= LEAST_SHARE * self._total)
        position = np.arange(BINS)
        start = np.argmax(self._total > 0, axis=1)
        last = np.maximum.accumulate(np.where(seen, position, start[:, None] - 1), axis=1)
        gap = (position - last > GAP_BINS) & (position >= start[:, None])
        ends = np.where(gap.any(axis=1), last[np.arange(SECTORS), np.argmax(gap, axis=1)], last[:, -1])
        return np.where(ends >= start, np.maximum((ends + 1) * BIN_M - END_M, 0.0), 0.0)

    def _floor(self, lower: PaddedPanorama, upper: PaddedPanorama) -> Flags:
        """Return the pixels (rows, columns) that match at the plane and less elsewhere."""
        columns = np.arange(-WINDOW[0], len(self._columns) + WINDOW[0]) % len(self._columns)
        across = (lower.pad_px + self._columns[columns]).astype(np.float32)
        below = self._upper_rows[:, columns]
        a = _smooth(lower.image)[self._rows][:, across.astype(np.intp)]
        b = cv2.remap(_smooth(upper.image), np.broadcast_to(across, below.shape).copy(), below, cv2.INTER_LINEAR,
                      borderMode=cv2.BORDER_REPLICATE)
        g, h = _gradient(a), _gradient(b)
        gg, hh = _windows(g * g), _windows(h * h)
        at_plane = _correlation(g, h, gg, hh)
        elsewhere = np.maximum.reduce([_correlation(g, np.roll(h, by, axis=0), gg, np.roll(hh, by, axis=0))
                                       for by in OTHER_ROWS])
        least = (GRADIENT_PER_NOISE * max(lower.noise_grey, upper.noise_grey)) ** 2
        found = (at_plane > LEAST_CORRELATION) & (at_plane > elsewhere + CLEARER) & (np.minimum(gg, hh) > least)
        return np.asarray(found[:, WINDOW[0] : -WINDOW[0]])


def _beside(counts: NDArray[np.generic]) -> Array:
    """Return the sums over each sector and those beside it."""
    counts = counts.astype(float)
    return np.asarray(counts + np.roll(counts, 1, axis=0) + np.roll(counts, -1, axis=0))


def _smooth(image: NDArray[np.uint8]) -> NDArray[np.uint8]:
    return np.asarray(cv2.blur(image, (BLUR_COLUMNS, 1)), np.uint8)


def _gradient(image: cv2.typing.MatLike) -> Greys:
    """Return the gradient along the columns, grey levels a row."""
    return np.asarray(cv2.Sobel(cv2.GaussianBlur(image, (1, 5), 0), cv2.CV_32F, 0, 1, ksize=3, scale=1 / 8), np.float32)


def _windows(image: Greys) -> Greys:
    return np.asarray(cv2.blur(image, WINDOW), np.float32)


def _correlation(a: Greys, b: Greys, aa: Greys, bb: Greys) -> Greys:
    return np.asarray(_windows(a * b) / np.sqrt(np.maximum(aa * bb, np.float32(1e-6))), np.float32)
