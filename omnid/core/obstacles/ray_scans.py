"""Scan of free floor and things of each pair: stereo, posterior of the rays, grid; over a floor that may lean.

A tilt (a, b) of the floor beyond that which the rig states changes the disparity of all its rows by
f t / h (a cos u + b sin u), whatever their range. So the difference of both views on the plane, by the gradient along
columns, is a linear measurement of a and b, and a Kalman filter adds up pairs. Floor without texture has no gradient,
and changes nothing. Only floor nearer than where a step down looks like a tilt counts, and only where it is known.
"""

from __future__ import annotations

import math
from typing import Final

import cv2
import numpy as np
from numpy.typing import NDArray

from calib.panorama import Cylinder
from omnid.core.obstacles.column import NEAREST_M, Columns, FloorPlane, floor_plane
from omnid.core.obstacles.grid import GridScan, ObstacleGrid, unknown_scan
from omnid.core.obstacles.panoramas import AROUND_ROWS, DIRECTIONS, FOCAL_PX, WorkingPair
from omnid.core.obstacles.posterior import RayBelief, RayPosterior
from omnid.core.obstacles.ray_kernels import RayParameters
from omnid.core.obstacles.settings import ScanSettings
from omnid.core.types.panorama import PaddedPanorama

Array = NDArray[np.float64]
Flags = NDArray[np.bool_]

LEAN_M: Final = 1.7  # range up to which floor shows the tilt: farther away a step down looks like one
LEAN_NS: Final = 500_000_000  # between two pairs by which a tilt that is known is followed
PRIOR_RAD: Final = math.radians(1.0)  # sigma of a rig that leans,
DRIFT_RAD: Final = math.radians(0.05)  # of its change from pair to pair,
SURE_RAD: Final = math.radians(0.3)  # and of a tilt that is used
LEAST_RAD: Final = math.radians(0.15)  # change of the tilt for which the tables are made again
CORRELATED: Final = 20.0  # pixels with one error: neighbours are smoothed, and share what is wrong


class RayScans:
    """Scans of a run by the rays of its pairs."""

    def __init__(self, cylinder: Cylinder, baseline_m: float, settings: ScanSettings) -> None:
        self._cylinder, self._baseline_m, self._settings = cylinder, baseline_m, settings
        self.grid = ObstacleGrid(FOCAL_PX * baseline_m, settings.max_range_m)
        # Tilt (2,) beyond what the rig states by all pairs, its covariance, and that of the tables.
        self._tilt, self._P, self._used = np.zeros(2), PRIOR_RAD**2 * np.eye(2), np.zeros(2)
        self._leaned_ns: int | None = None  # stamp of the last pair by which the tilt was followed
        azimuth = math.pi - (np.arange(DIRECTIONS) + 0.5) * (math.tau / DIRECTIONS)
        self._way = np.column_stack([np.cos(azimuth), np.sin(azimuth)])
        self.belief: RayBelief | None = None  # of the newest pair

    def set_floor(self, T_rect_base: Array, visible: Flags) -> None:
        """Take T_rect_base (4, 4), from the base level on the floor to the panoramas, and their pixels (H, W)."""
        self._plane, self._visible = floor_plane(T_rect_base), visible
        self.grid.set_floor(T_rect_base)
        self._make_tables()

    def add(
        self, stamp_ns: int, T_odom_base: Array, lower: PaddedPanorama, upper: PaddedPanorama, lost: Flags | None
    ) -> GridScan:
        """Return the scan at a pair, whose base has the planar pose T_odom_base (4, 4).

        lost (H, W): pixels that are no evidence, None: all in view are.
        """
        if not self._posterior.shows_floor:
            return unknown_scan()
        # 1. The belief, with the look of floor that is known, and the grid.
        pair = self._columns.panoramas.pair(lower, upper, lost)
        known = self.grid.is_floor(T_odom_base, self._posterior.ranges_m, DIRECTIONS)
        self.belief = self._posterior.belief(pair, self._columns.evidence(pair), known)
        scan = self.grid.update(stamp_ns, T_odom_base, self.belief)
        # 2. The tilt, for the next pair.
        is_due = self._leaned_ns is None or not 0 <= stamp_ns - self._leaned_ns < LEAN_NS
        if is_due or np.diag(self._P).max() > SURE_RAD**2:
            self._leaned_ns = stamp_ns
            self._observe_tilt(T_odom_base, pair)
            is_sure = np.diag(self._P) < SURE_RAD**2
            if np.abs((self._tilt - self._used)[is_sure]).max(initial=0.0) > LEAST_RAD:
                self._used = np.where(is_sure, self._tilt, self._used)
                self._make_tables()
        return scan

    def _observe_tilt(self, T_odom_base: Array, pair: WorkingPair) -> None:
        """Take a pair into the filter of the tilt, by near floor that is known."""
        self._P = self._P + DRIFT_RAD**2 * np.eye(2)
        rows = self._near_rows
        known = self.grid.is_floor(T_odom_base, self._row_ranges_m[rows], DIRECTIONS) & pair.seen[rows]
        if not known.any():
            return
        # 1. Difference and gradient of both views on the plane.
        at = self._columns.panoramas.plane_rows[rows]
        lower, upper = (image - cv2.blur(image, (1, AROUND_ROWS)) for image in (pair.lower, pair.upper))
        above, share = np.floor(at).astype(int), (at % 1)[:, None]
        both = np.stack([upper, (np.roll(upper, -1, 0) - np.roll(upper, 1, 0)) / 2])
        shown, gradient = both[:, above] * (1 - share) + both[:, above + 1] * share
        difference = lower[rows] - shown
        # 2. Normal equations of the two slopes; single pixels that differ by much count little.
        sigma = max(1.48 * float(np.median(np.abs(difference[known]))), 0.3)
        weight = known / (1.0 + (difference / (1.5 * sigma)) ** 2)
        squares, products = (weight * gradient * gradient).sum(0), (weight * gradient * difference).sum(0)
        # The gradient has noise of its own: without that share a plain floor would seem to measure something.
        textured = max(1.0 - float(weight.sum()) * sigma**2 / 4 / max(float(squares.sum()), 1e-6), 0.0)
        px_per_rad = FOCAL_PX * self._baseline_m / self._plane.height_m
        scale = px_per_rad / (sigma * math.sqrt(CORRELATED))
        H = (scale * textured) ** 2 * np.einsum("u,ui,uj->ij", squares, self._way, self._way)
        y = scale**2 * textured / px_per_rad * (self._way.T @ products)
        # 3. The filter: information of the pair, about the tilt that its plane has.
        information = np.linalg.inv(self._P)
        self._P = np.linalg.inv(information + H)
        self._tilt = self._P @ (information @ self._tilt + H @ self._used + y)

    def _make_tables(self) -> None:
        """Make the tables of the floor's plane, with its tilt."""
        plane, visible = self._plane, self._visible
        tilted = FloorPlane(plane.height_m, float(plane.a + self._used[0]), float(plane.b + self._used[1]))
        ranges_m = NEAREST_M, self._settings.max_range_m
        cylinder, heights_m = self._cylinder, self._settings.heights_m
        self._columns = Columns(cylinder, self._baseline_m, tilted, heights_m, ranges_m, visible)
        self._posterior = RayPosterior(self._columns, plane.height_m, self._baseline_m, RayParameters())
        panoramas = self._columns.panoramas
        below = np.maximum(np.arange(panoramas.height) - panoramas.row0, 1e-6)
        self._row_ranges_m = FOCAL_PX * plane.height_m / below
        in_view = panoramas.plane_rows < self._columns.last_row - 2
        self._near_rows = np.flatnonzero((self._row_ranges_m < LEAN_M) & in_view)
