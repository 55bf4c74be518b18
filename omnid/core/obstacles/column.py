"""Evidence of one pair, for each direction and range: log-likelihood ratios of the floor and of surfaces.

An epipolar line is a column, so each direction is a problem of its own, whose floor has a disparity that is linear in
the row. Each patch of a column is explained by one disparity. Where there is no texture all of them are as likely, and
the logarithm of the ratio is 0. docs/obstacles.md has them.

Panoramas are brought to one working size (panoramas.py), so that no parameter depends on the size of the images.
"""

from __future__ import annotations

import math
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from calib import se3
from calib.panorama import Cylinder
from omnid.core.obstacles import evidence_kernels as kernels
from omnid.core.obstacles.panoramas import DIRECTIONS, FOCAL_PX, UNITS, Views, WorkingPanoramas

Array = NDArray[np.float64]
Floats = NDArray[np.float32]
Flags = NDArray[np.bool_]
Tables = NDArray[np.int32]

NEAREST_M: Final = 0.5  # Least range at which surfaces are searched.
OUTLIER: Final = np.uint8(4 * UNITS)  # Most units by which a pixel differs, because more than four sigmas are no noise.
# Log-likelihood by a sigma of difference of a direction: 1 would be that of independent pixels; and of planes beside
# the floor, which are compared in seven directions together.
DIFFERENCE_RATIO, LEVEL_RATIO = np.float32(0.5), np.float32(1.5)
THIN_M: Final = 0.035  # Width of the thinnest obstacle. With 0.03, by trial, more bases stood on polished floors.
# Rows on either side of those in which the floor has a disparity. Measured: with 1, 2 and 3 of them 10.5, 11.1 and 11.8
# % of the directions of things are called free beyond these, and 93.7, 94.9 and 95.8 % of open ones up to 1.5 m.
BIN_ROWS: Final = 2
# Least difference of disparity by which something is not the floor. Measured: 0.87 to 1.95 are alike.
FLOOR_PX: Final = 1.3
# Lower and higher disparities than the floor's that may explain its rows. Measured: two thirds to 1.5 times are alike.
OTHERS_PX: Final = (12, 25)
EDGE_M: Final = 0.05  # least fall of the floor that is an edge, because the base's wheels pass lower ones
LEVEL_STEP_PX: Final = 0.375  # between planes below the floor, because matching resolves that
LEVEL_STEPS: Final = 3  # planes on either side, twice as far apart: enough to where others are compared
# Log-likelihood by which the best of the deeper planes may fit better than the floor by noise, 1.5 in the mean of a
# plain floor. With 3, by trial, bases stood on boards of 10 cm that are nearly alike.
DEEP_NOISE: Final = np.float32(10.0)
# Share of the least height and fall by which a floor is uneven, so that two more planes are floor.
EVEN_SHARE: Final = 0.33
# An object often hides the floor near itself: decay of the prior with the disparity, and the share of it that is left
# far away. Measured: two thirds to 1.5 times as much are alike.
ADJACENT_PX, DISTANT_SHARE = 4.0, 0.1
# Rows of half a strip of a surface; the other half is the first one of the next strip.
HALF_ROWS: Final = 4
STRIP_BOUND: Final = np.float32(3.0)  # limit of the log-likelihood ratio of a strip
STRIP_PRIOR: Final = np.float32(0.5)  # log-odds by which a strip of a surface must exceed its other explanations
# Probability of the floor in rows that may show it, by that of one disparity; and of a disparity below the floor, where
# only holes are, and what a polished floor mirrors. By trial: of walls of bricks, which may be farther ones below the
# floor, 94 % were found with 0.1 and 0.03, 92 % with 0.3, 66 % with 1.
FLOOR_WEIGHT, BELOW_WEIGHT = np.float32(10.0), np.float32(0.1)
LEAST_OTHERS: Final = 1e-4  # bound of the mean likelihood of other explanations


class FloorPlane(NamedTuple):
    """Floor in the rectified frame: z = -height_m + r (a cos(azimuth) + b sin(azimuth))."""

    height_m: float
    a: float
    b: float


class ColumnEvidence(NamedTuple):
    """Log-likelihood ratios of K disparities and DIRECTIONS directions of the rectified frame; k = 0 is far."""

    # (K, DIRECTIONS) of the floor from disparity k to k + 1, in a direction and those that follow it which something
    # thin hides together.
    floor: Floats
    surface: Floats  # (K, DIRECTIONS) of the best run of rows within the robot's heights, where k fits best
    level: Floats  # (2, K, DIRECTIONS) of the floor against planes that are just above and below it


def floor_plane(T_rect_floor: Array) -> FloorPlane:
    """Return the floor's plane z = 0 of a level frame, from which T_rect_floor (4, 4) leads to the rectified one."""
    T = se3.inverse(T_rect_floor)
    return FloorPlane(float(T[2, 3] / T[2, 2]), float(-T[2, 0] / T[2, 2]), float(-T[2, 1] / T[2, 2]))


class Columns:
    """Computes the evidence of pairs; tables are computed once for a plane of the floor."""

    def __init__(
        self,
        cylinder: Cylinder,
        baseline_m: float,
        plane: FloorPlane,
        heights_m: tuple[float, float],
        ranges_m: tuple[float, float],
        visible: Flags,
        *,
        is_ramp: bool = False,
    ) -> None:
        """heights_m: of surfaces over the floor: lower ones are floor, higher ones are passed below. ranges_m: nearest
        and farthest; visible (H, W): pixels of a panorama that both cameras see."""
        self._baseline_m, self._plane, self._heights_m = baseline_m, plane, heights_m
        self.floor_slope = baseline_m / plane.height_m
        self.panoramas = WorkingPanoramas(cylinder, (plane.a, plane.b), self.floor_slope, visible, is_steep=is_ramp)
        self._row0 = self.panoramas.row0
        self.at_1m = FOCAL_PX * baseline_m  # disparity
        self.bins = math.ceil(self.at_1m / ranges_m[0])
        self.first_bin = max(1, math.floor(self.at_1m / ranges_m[1]))  # first disparity that is compared
        share = self.panoramas.visible[:, self.panoramas.shown].mean(axis=1)
        in_view = share > (0.0 if is_ramp else 0.5)
        first_row, self.last_row = _rows_in_use(in_view, round(self._row0))
        self._patches, self._offsets = self._made_patches()
        self._strips = self._made_strips(first_row)
        self._prior = np.exp(-np.arange(self.bins) / ADJACENT_PX).astype(np.float32) + np.float32(DISTANT_SHARE)

    def evidence(self, surfaces: Views, views: Views) -> ColumnEvidence:
        """Return the evidence of a pair, normalised for surfaces and for floor."""
        others, level = np.empty((self.bins, DIRECTIONS), np.float32), np.empty((2, self.bins, DIRECTIONS), np.float32)
        tables = self.panoramas.plane_rows, self._patches, self._offsets, self._prior
        scales = DIFFERENCE_RATIO / np.float32(UNITS), LEVEL_RATIO / np.float32(64 * UNITS)
        kernels.floor_evidence(*views, *tables, OUTLIER, *scales, DEEP_NOISE, others, level)
        together = self._patches[:, kernels.PATCH_THIN, None].astype(np.float32)
        floor = -together * np.log(np.maximum(others, np.float32(LEAST_OTHERS)))
        return ColumnEvidence(floor, self._surface(surfaces), level)

    def _surface(self, views: Views) -> Floats:
        """Return the log-likelihood ratios (K, DIRECTIONS) of the best run of rows, where k fits best."""
        surface, scale = np.empty((self.bins, DIRECTIONS), np.float32), DIFFERENCE_RATIO / np.float32(UNITS)
        numbers = FLOOR_WEIGHT, BELOW_WEIGHT, STRIP_BOUND, STRIP_PRIOR
        compared = views.lower, views.upright, views.plane, views.live
        kernels.surface_evidence(*compared, self._strips, OUTLIER, scale, *numbers, surface)
        # A surface fits a little at the next disparities, too.
        nearer, farther = (np.roll(surface, shift, axis=0) for shift in (-1, 1))
        return np.where((surface >= nearer) & (surface >= farther), surface, np.float32(0))

    def _made_patches(self) -> tuple[Tables, Floats]:
        """Return the tables of patches and of planes of kernels.floor_evidence."""
        h, (low_m, _) = self._plane.height_m, self._heights_m
        last_row, plane_rows = self.panoramas.height - 2, self.panoramas.plane_rows
        patches = np.zeros((self.bins, 7), np.int32)
        offsets = np.full((4, self.bins, math.ceil(OTHERS_PX[0] / LEVEL_STEP_PX)), np.nan, np.float32)
        for k in range(self.first_bin, self.bins):
            first, end = (math.ceil(self._row0 + n / self.floor_slope) for n in (k, k + 1))
            middle = self.floor_slope * ((first + end - 1) / 2 - self._row0)
            first, end = first - BIN_ROWS, end + BIN_ROWS
            if first < 0 or end + self.floor_slope * (end - self._row0) > self.last_row:
                continue
            # Planes above and just below, to where other disparities are compared, and deeper ones to the lowest
            # disparity: floor that repeats itself, and falls deep at an edge, fits there by another period.
            up, down = (z * (k + 0.5) / (h - z) for z in (low_m, -EDGE_M))
            beside = 2 * LEVEL_STEP_PX * np.arange(LEVEL_STEPS)
            deep = down - LEVEL_STEP_PX * np.arange(offsets.shape[2])
            deep = deep[(deep <= -FLOOR_PX - 1) & (deep > -min(OTHERS_PX[0], k))]
            near = [one[(np.abs(one) < FLOOR_PX + 1) | (beside == 0)] for one in (up + beside, down - beside)]
            planes = np.array([0.0, EVEN_SHARE * up, EVEN_SHARE * down]), *near, deep
            rows = plane_rows[[first, end - 1]]
            kept = [one[(rows[0] + one >= 0) & (rows[1] + one <= last_row)] for one in planes]
            if len(kept[0]) < len(planes[0]) or not all(map(len, kept[:3])):
                continue
            for kind, one in enumerate(kept):
                offsets[kind, k, : len(one)] = one
            begin, last = max(0, k - OTHERS_PX[0]), min(self.bins, self.last_row - end, k + OTHERS_PX[1])
            apart = math.floor(middle - FLOOR_PX), math.ceil(middle + FLOOR_PX)
            thin = max(round(THIN_M * (k + 0.5) / self.at_1m * DIRECTIONS / math.tau), 1)
            patches[k] = first, end, begin, *apart, last, thin
        return patches, offsets

    def _made_strips(self, first_row: int) -> Tables:
        """Return the table of kernels.surface_evidence."""
        found = []
        h, (low_m, high_m) = self._plane.height_m, self._heights_m
        for first in range(first_row, self.last_row - 2 * HALF_ROWS, HALF_ROWS):
            end = first + 2 * HALF_ROWS
            last = min(self.bins, self.last_row - end)
            fall = (first + end - 1) / 2 - self._row0
            if fall <= 0:
                mine = math.ceil(self._baseline_m * -fall / max(high_m - h, 1e-3))
            else:
                floor = self.floor_slope * fall
                mine = math.ceil(max(floor * h / (h - low_m), floor + FLOOR_PX))
            below = max(math.floor(self.floor_slope * (first - self._row0) - FLOOR_PX), 0)
            found.append((first, end, max(self.first_bin, mine), max(last, 0), fall > 0, below))
        # Strips above the first and below the last that may show a surface are not needed.
        useful = [n for n, (_, _, mine, last, *_) in enumerate(found) if last > mine]
        return np.array(found[useful[0] : useful[-1] + 1] if useful else np.zeros((0, 6)), np.int32)


def _rows_in_use(shown: Flags, horizon: int) -> tuple[int, int]:
    """Return the first row that is shown, and the last of the first run of such rows below the horizon.

    Floor nearer than a scan that no direction shows, such as the reflection of a lens, is not used: what comes would be
    out of view on its way there, and so would the floor on which a base drives.
    """
    rows = np.flatnonzero(shown)
    below = rows[rows > horizon]
    if not below.size:
        return int(rows[0]), int(rows[-1])
    gaps = np.flatnonzero(np.diff(below) > 1)
    return int(rows[0]), int(below[gaps[0]] if gaps.size else below[-1])
