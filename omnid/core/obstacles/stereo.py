"""Stereo evidence of one pair: log-likelihood ratios of the floor and of surfaces, for each direction and disparity.

An epipolar line is a column, so each direction is a problem of its own, whose floor has a disparity that is linear in
the row. Where there is no texture all disparities are as likely, and the logarithm of the ratio is 0 but for noise.
docs/obstacles.md has the equations.
"""

from __future__ import annotations

import math
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from calib import se3
from calib.panorama import Cylinder
from omnid.core.obstacles import stereo_kernels as kernels
from omnid.core.obstacles.panoramas import DIRECTIONS, FOCAL_PX, WorkingPair, WorkingPanoramas

Array = NDArray[np.float64]
Floats = NDArray[np.float32]
Flags = NDArray[np.bool_]
Tables = NDArray[np.int32]

NEAREST_M: Final = 0.5  # least range at which surfaces are searched
# Rows on either side of those in which the floor has a disparity. Measured: with 1, 2 and 3 of them 10.5, 11.1 and 11.8
# % of the directions of things are called free beyond these, and 93.7, 94.9 and 95.8 % of open ones up to 1.5 m.
BIN_ROWS: Final = 2
FLOOR_PX: Final = 1.3  # difference of disparity by which something is not the floor. Measured: 0.87 to 1.95 are alike.
DEEPEST_PX: Final = 12  # by which the deepest planes are compared
EDGE_M: Final = 0.05  # least fall of the floor that is an edge: wheels pass lower ones
PLANE_STEP_PX: Final = 0.375  # between planes below the floor; matching resolves that
BESIDE_STEPS_PX: Final = 2 * PLANE_STEP_PX * np.arange(3)  # of the planes just above and below, to where others begin
# Share of the least height and fall by which a floor is uneven, so that two more planes are floor.
EVEN_SHARE: Final = 0.33
HALF_ROWS: Final = 4  # half a strip of a surface, from which the next strip begins


class FloorPlane(NamedTuple):
    """Floor in the rectified frame: z = -height_m + r (a cos(azimuth) + b sin(azimuth))."""

    height_m: float
    a: float
    b: float


class StereoEvidence(NamedTuple):
    """Log-likelihood ratios of K disparities and DIRECTIONS directions of the rectified frame; k = 0 is far."""

    surface: Floats  # (K, DIRECTIONS) of the best run of rows within the robot's heights, where k fits best
    level: Floats  # (2, K, DIRECTIONS) of the floor from disparity k to k + 1 against planes above and below it


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
        self.panoramas = WorkingPanoramas(cylinder, (plane.a, plane.b), self._floor_slope, visible)
        self._row0 = self.panoramas.row0
        self.at_1m = FOCAL_PX * baseline_m  # disparity
        self.bins = math.ceil(self.at_1m / ranges_m[0])
        self.first_bin = max(1, math.floor(self.at_1m / ranges_m[1]))  # first disparity that is compared
        in_view = self.panoramas.visible[:, self.panoramas.shown].mean(axis=1) > 0.5
        first_row, self.last_row = _rows_in_use(in_view, round(self._row0))
        self._patches, self._offsets = self._made_patches()
        self._strips = self._made_strips(first_row)

    def evidence(self, pair: WorkingPair) -> StereoEvidence:
        """Return the evidence of a pair."""
        lower, upper, upright, plane, live = self.panoramas.views(pair)
        level, surface = np.empty((2, self.bins, DIRECTIONS), np.float32), np.empty((self.bins, DIRECTIONS), np.float32)
        kernels.level_evidence(lower, upper, live, self.panoramas.plane_rows, self._patches, self._offsets, level)
        kernels.surface_evidence(lower, upright, plane, live, self._strips, surface)
        # A surface fits a little at the next disparities, too.
        nearer, farther = (np.roll(surface, shift, axis=0) for shift in (-1, 1))
        best = np.where((surface >= nearer) & (surface >= farther), surface, np.float32(0))
        return StereoEvidence(best, level)

    def _made_patches(self) -> tuple[Tables, Floats]:
        """Return the tables of patches and of planes of kernels.level_evidence."""
        h, low_m = self._plane.height_m, self._heights_m[0]
        last_row, plane_rows = self.last_row, self.panoramas.plane_rows
        patches = np.zeros((self.bins, 2), np.int32)
        offsets = np.full((4, self.bins, math.ceil(DEEPEST_PX / PLANE_STEP_PX)), np.nan, np.float32)
        for k in range(self.first_bin, self.bins):
            first, end = (math.ceil(self._row0 + n / self._floor_slope) for n in (k, k + 1))
            first, end = first - BIN_ROWS, end + BIN_ROWS
            if first < 0 or end + self._floor_slope * (end - self._row0) > last_row:
                continue
            # Planes above and just below, and deeper ones to the lowest disparity: floor that repeats itself, and falls
            # deep at an edge, fits there by another period.
            up, down = (z * (k + 0.5) / (h - z) for z in (low_m, -EDGE_M))
            deep = down - PLANE_STEP_PX * np.arange(offsets.shape[2])
            deep = deep[(deep <= -FLOOR_PX - 1) & (deep > -min(DEEPEST_PX, k))]
            near = [
                one[(np.abs(one) < FLOOR_PX + 1) | (BESIDE_STEPS_PX == 0)]
                for one in (up + BESIDE_STEPS_PX, down - BESIDE_STEPS_PX)
            ]
            planes = np.array([0.0, EVEN_SHARE * up, EVEN_SHARE * down]), *near, deep
            rows = plane_rows[[first, end - 1]]
            kept = [one[(rows[0] + one >= 0) & (rows[1] + one <= last_row)] for one in planes]
            if len(kept[0]) < len(planes[0]) or not all(map(len, kept[:3])):
                continue
            patches[k] = first, end
            for kind, one in enumerate(kept):
                offsets[kind, k, : len(one)] = one
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
                floor = self._floor_slope * fall
                mine = math.ceil(max(floor * h / (h - low_m), floor + FLOOR_PX))
            below = max(math.floor(self._floor_slope * (first - self._row0) - FLOOR_PX), 0)
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
