"""Evidence of one pair, for each direction and range: log-likelihood ratios of the floor and of surfaces.

An epipolar line is a column, so each direction is a problem of its own, whose floor has a disparity that is linear in
the row. Each patch of a column is explained by one disparity. Where there is no texture all of them are as likely, and
the logarithm of the ratio is 0. docs/obstacles.md has them.

Panoramas are brought to one working size (pair_views.py), so that no parameter depends on the size of the images.
"""

from __future__ import annotations

import math
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from calib import se3
from calib.panorama import Cylinder
from omnid.core.obstacles import column_kernels as kernels
from omnid.core.obstacles.pair_views import DIRECTIONS, FOCAL_PX, UNITS, Views, WorkingPair, WorkingPanoramas
from omnid.core.obstacles.surface_kernels import surface_evidence

Array = NDArray[np.float64]
Floats = NDArray[np.float32]
Flags = NDArray[np.bool_]
Tables = NDArray[np.int32]

NEAREST_M: Final = 0.5  # Least range at which surfaces are searched.
# Rows of panoramas in a radian; by trial: with 104 all of 4 goals were reached, with 87 not.
FLOOR_FOCAL_PX: Final = 100.0
# Share of the rows of a patch that must be in view. Measured: 0.34 to 0.75 are alike.
LEAST_SEEN: Final = 0.5
OUTLIER: Final = np.uint8(48)  # Most units by which a pixel differs, because more than four sigmas are no noise.
DIFFERENCE_RATIO: Final = 0.5  # log-likelihood by a sigma of difference: 1 would be that of independent pixels
THIN_M: Final = 0.035  # Width of the thinnest obstacle. With 0.03, by trial, more bases stood on polished floors.
# Rows on either side of those in which the floor has a disparity. Measured: with 1, 2 and 3 of them 10.5, 11.1 and 11.8
# % of the directions of things are called free beyond these, and 93.7, 94.9 and 95.8 % of open ones up to 1.5 m.
BIN_ROWS: Final = 2
# Least difference of disparity by which something is not the floor. Measured: 0.87 to 1.95 are alike.
FLOOR_PX: Final = 1.3
# Lower and higher disparities than the floor's that may explain its rows. Measured: two thirds to 1.5 times are alike.
OTHERS_PX: Final = (12, 25)
EDGE_M: Final = 0.05  # least fall of the floor that is an edge, because the base's wheels pass lower ones
LEVEL_STEP_PX: Final = 0.75  # Step between planes next to the floor, because matching resolves half of it.
LEVEL_STEPS: Final = 3  # enough at all disparities to where others are compared
# Step between planes deep below the floor; narrow, because a plane that is missed is no evidence against it.
DEEP_STEP_PX: Final = 0.375
# Log-likelihood by which the best of those planes may fit better than the floor by noise, 1.5 in the mean of a plain
# floor. With 3, by trial, bases stood on boards of 10 cm that are nearly alike.
DEEP_NOISE: Final = 10.0
# Share of the least height and fall by which a floor is uneven, so that two more planes are floor.
EVEN_SHARE: Final = 0.33
LEVEL_RATIO: Final = 1.5  # log-likelihood by a sigma: that of single directions by three that are no more alike
# An object often hides the floor near itself: decay of the prior with the disparity, and the share of it that is left
# far away. Measured: two thirds to 1.5 times as much are alike.
ADJACENT_PX, DISTANT_SHARE = 4.0, 0.1
# Rows of a strip of a surface, and rows that two strips share. Measured: with 3 and 6 rows 9.4 and 11.2 % of the
# directions of things are called free beyond these instead of 11.1 %; with 1 and 3 rows in common 13.7 and 8.8 %, and
# 0.3 and 0.8 % instead of 0.5 % of the directions have a false obstacle.
STRIP_ROWS, STRIP_OVERLAP = 4, 2
# Limit of the log-likelihood ratio of a strip. Measured: with 2 and 4.5 11.4 and 11.0 % instead of 11.1 % (as above).
STRIP_BOUND: Final = 3.0
# Log-odds by which a strip of a surface must exceed its other explanations. Measured: 10.2 and 12.2 %
# with 0.34 and 0.75 (as above).
STRIP_PRIOR: Final = 0.5
# Probability of the floor in rows that may show it, by that of one disparity. Measured: 10.8 and 11.3 %
# with 6.7 and 15 (as above).
FLOOR_WEIGHT: Final = 10.0
# The same of a disparity below the floor, where only holes are, and what a polished floor mirrors. By trial: of walls
# of bricks, which may be farther ones below the floor, 94 % were found with 0.1 and 0.03, 92 % with 0.3, 66 % with 1.
BELOW_WEIGHT: Final = 0.1
# Bound of the mean likelihood of other explanations. Measured: two thirds to 1.5 times as much are alike.
LEAST_OTHERS: Final = 1e-4


class FloorPlane(NamedTuple):
    """Floor in the rectified frame: z = -height_m + r (a cos(azimuth) + b sin(azimuth))."""

    height_m: float
    a: float
    b: float


class ColumnEvidence(NamedTuple):
    """Log-likelihood ratios of K disparities and DIRECTIONS directions of the rectified frame; k = 0 is far."""

    # (K, DIRECTIONS) of the floor from disparity k to k + 1, in a direction and those that follow it which something
    # thin hides together; NaN where both cameras cannot see it.
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
    ) -> None:
        """heights_m: of surfaces over the floor: lower ones are floor, higher ones are passed below. ranges_m: nearest
        and farthest; visible (H, W): pixels of a panorama that both cameras see."""
        self._baseline_m, self._plane, self._heights_m = baseline_m, plane, heights_m
        self._floor_slope = baseline_m / plane.height_m
        self._panoramas = WorkingPanoramas(cylinder, (plane.a, plane.b), self._floor_slope, visible)
        self._height, self._row0 = self._panoramas.height, self._panoramas.row0
        self._plane_rows = self._panoramas.plane_rows
        self.at_1m = FOCAL_PX * baseline_m  # disparity
        self.bins = math.ceil(self.at_1m / ranges_m[0])
        self._first_bin = max(1, math.floor(self.at_1m / ranges_m[1]))
        self._visible = self._panoramas.visible
        in_view = self._visible[:, self._panoramas.shown].mean(axis=1) > 0.5
        self._first_row, self._last_row = _rows_in_use(in_view, round(self._row0))
        self._floor_bins, self._strips = self._made_floor_bins(), self._made_strips()
        self._offsets = self._made_offsets()
        self._leave_out_cut_planes()
        self._prior = np.exp(-np.arange(self.bins) / ADJACENT_PX).astype(np.float32) + np.float32(DISTANT_SHARE)
        self._compared = self._made_compared()

    def evidence(self, pair: WorkingPair) -> ColumnEvidence:
        """Return the evidence of a pair."""
        surfaces, floor = self._panoramas.views(pair)
        return ColumnEvidence(self._floor(floor), self._surface(surfaces), self._level(floor))

    @property
    def panoramas(self) -> WorkingPanoramas:
        """The working panoramas of this plane."""
        return self._panoramas

    @property
    def visible(self) -> Flags:
        """Pixels (H, DIRECTIONS) of the working panoramas that both cameras see."""
        return self._visible

    @property
    def first_bin(self) -> int:
        """First disparity that is compared."""
        return self._first_bin

    @property
    def last_row(self) -> int:
        """Last row in use."""
        return self._last_row

    def _floor(self, views: Views) -> Floats:
        """Return the log-likelihood ratios (K, DIRECTIONS) of the floor against all other disparities."""
        others, scale = np.empty((self.bins, DIRECTIONS), np.float32), np.float32(DIFFERENCE_RATIO / UNITS)
        compared = views.lower, views.upright, views.plane, views.live
        kernels.floor_evidence(*compared, self._floor_bins, OUTLIER, scale, self._prior, others)
        together = self._floor_bins[:, kernels.FLOOR_THIN, None].astype(np.float32)
        floor = -together * np.log(np.maximum(others, np.float32(LEAST_OTHERS)))
        floor[~self._compared] = np.nan
        return floor

    def _surface(self, views: Views) -> Floats:
        """Return the log-likelihood ratios (K, DIRECTIONS) of the best run of rows, where k fits best."""
        surface, scale = np.empty((self.bins, DIRECTIONS), np.float32), np.float32(DIFFERENCE_RATIO / UNITS)
        weights = np.float32(FLOOR_WEIGHT), np.float32(BELOW_WEIGHT)
        limits = np.float32(STRIP_BOUND), np.float32(STRIP_PRIOR)
        compared = views.lower, views.upright, views.plane, views.live
        surface_evidence(*compared, self._strips, OUTLIER, scale, *weights, *limits, surface)
        return surface

    def _level(self, views: Views) -> Floats:
        """Return the log-likelihood ratios (2, K, DIRECTIONS) of the floor against planes just above and below it."""
        level, scale = np.empty((2, self.bins, DIRECTIONS), np.float32), np.float32(LEVEL_RATIO / 64 / UNITS)
        compared = views.lower, views.upper, self._plane_rows, views.live
        noise = np.float32(DEEP_NOISE)
        kernels.level_evidence(*compared, self._floor_bins, self._offsets, OUTLIER, scale, noise, level)
        return level

    def _made_floor_bins(self) -> Tables:
        """Return the table of kernels.floor_evidence."""
        table = np.zeros((self.bins, 7), np.int32)
        for k in range(self._first_bin, self.bins):
            first, end = (math.ceil(self._row0 + n / self._floor_slope) for n in (k, k + 1))
            middle = self._floor_slope * ((first + end - 1) / 2 - self._row0)
            first, end = first - BIN_ROWS, end + BIN_ROWS
            if first < 0 or end + self._floor_slope * (end - self._row0) > self._last_row:
                continue
            begin, last = max(0, k - OTHERS_PX[0]), min(self.bins, self._last_row - end, k + OTHERS_PX[1])
            table[k] = (
                first,
                end,
                begin,
                math.floor(middle - FLOOR_PX),
                math.ceil(middle + FLOOR_PX),
                last,
                max(round(THIN_M * (k + 0.5) / self.at_1m * DIRECTIONS / math.tau), 1),
            )
        return table

    def _made_compared(self) -> Flags:
        """Return the patches (K, DIRECTIONS) of the floor that are seen in all directions that are judged together."""
        found = np.zeros((self.bins, DIRECTIONS), bool)
        for k, (first, end, *_) in enumerate(self._floor_bins):
            if end:
                seen = self._visible[first:end].mean(axis=0) >= LEAST_SEEN
                together = range(self._floor_bins[k, kernels.FLOOR_THIN])
                found[k] = np.logical_and.reduce([np.roll(seen, -shift) for shift in together])
        return found

    def _leave_out_cut_planes(self) -> None:
        """Leave out patches of the floor for which a plane beside it lies beyond the panorama's last row."""
        for k, (first, end, *_) in enumerate(self._floor_bins):
            if not end:
                continue
            lowest = self._plane_rows[first:end].max() + self._offsets[:, k] + 1 > self._height - 1
            highest = self._plane_rows[first:end].min() + self._offsets[:, k] < 0
            self._offsets[:, k][lowest | highest] = np.nan
            if np.isnan(self._offsets[:3, k, 0]).any():
                self._floor_bins[k] = 0

    def _made_offsets(self) -> Floats:
        """Return the differences of disparity of kernels.level_evidence."""
        h = self._plane.height_m
        steps = math.ceil(OTHERS_PX[0] / DEEP_STEP_PX)
        offsets = np.full((4, self.bins, steps), np.nan, np.float32)
        for k in range(self.bins):
            up, down = (z * (k + 0.5) / (h - z) for z in (self._heights_m[0], -EDGE_M))
            offsets[0, k, :3] = 0.0, EVEN_SHARE * up, EVEN_SHARE * down
            for j in range(LEVEL_STEPS):
                step = j * LEVEL_STEP_PX
                for kind, offset in ((1, up + step), (2, down - step)):
                    if j == 0 or abs(offset) < FLOOR_PX + 1:
                        offsets[kind, k, j] = offset
            # Planes deep below, to the lowest disparity that the floor is compared with: one has the floor's period.
            deeper = down - DEEP_STEP_PX * np.arange(steps)
            is_deep = (deeper <= -FLOOR_PX - 1) & (deeper > -min(OTHERS_PX[0], k))
            offsets[3, k, is_deep] = deeper[is_deep]
        return offsets

    def _made_strips(self) -> Tables:
        """Return the table of surface_evidence."""
        found = []
        h, (low_m, high_m) = self._plane.height_m, self._heights_m
        for v in range(self._first_row + STRIP_OVERLAP, self._last_row - STRIP_ROWS - STRIP_OVERLAP, STRIP_ROWS):
            first, end = v - STRIP_OVERLAP, v + STRIP_ROWS + STRIP_OVERLAP
            last = min(self.bins, self._last_row - end)
            fall = v + (STRIP_ROWS - 1) / 2 - self._row0
            if fall <= 0:
                mine = math.ceil(self._baseline_m * -fall / max(high_m - h, 1e-3))
            else:
                floor = self._floor_slope * fall
                mine = math.ceil(max(floor * h / (h - low_m), floor + FLOOR_PX))
            below = max(math.floor(self._floor_slope * (first - self._row0) - FLOOR_PX), 0)
            found.append((first, end, max(self._first_bin, mine), max(last, 0), fall > 0, below))
        return np.array(found, np.int32)


def _rows_in_use(shown: Flags, horizon: int) -> tuple[int, int]:
    """Return the first row that is shown, and the last of the first run of such rows below the horizon.

    Floor nearer than a ring that no direction shows, such as the reflection of a lens, is not used: what comes would be
    out of view on its way there, and so would the floor on which a base drives.
    """
    rows = np.flatnonzero(shown)
    below = rows[rows > horizon]
    if not below.size:
        return int(rows[0]), int(rows[-1])
    gaps = np.flatnonzero(np.diff(below) > 1)
    return int(rows[0]), int(below[gaps[0]] if gaps.size else below[-1])
