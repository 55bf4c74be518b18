"""Ring of free floor and things of each pair: stereo, posterior of the rays, grid; over a floor that may lean."""

from __future__ import annotations

import math
from typing import Final

import numpy as np
from numpy.typing import NDArray

from calib.panorama import Cylinder
from omnid.core.obstacles.column import NEAREST_M, ColumnEvidence, Columns, FloorPlane, floor_plane
from omnid.core.obstacles.grid import GridRing, ObstacleGrid, unknown_ring
from omnid.core.obstacles.lean import LEAST_RAD, Lean
from omnid.core.obstacles.pair_views import DIRECTIONS, FOCAL_PX, WorkingPair
from omnid.core.obstacles.parameters import GridParameters
from omnid.core.obstacles.posterior import RayPosterior
from omnid.core.obstacles.ray_kernels import RayParameters
from omnid.core.obstacles.settings import RingSettings
from omnid.core.types.panorama import PaddedPanorama

Array = NDArray[np.float64]
Flags = NDArray[np.bool_]

LEAN_M: Final = 1.7  # Range up to which floor tells the lean: farther away a step down looks like one.
LEAN_NS: Final = 500_000_000  # between two pairs by which a lean that is known is followed
SURE_RAD: Final = math.radians(0.3)  # sigma of a tilt that is used


class RayRings:
    """Rings of a run by the rays of its pairs."""

    def __init__(self, cylinder: Cylinder, baseline_m: float, settings: RingSettings) -> None:
        self._cylinder, self._baseline_m, self._settings = cylinder, baseline_m, settings
        self._rays = RayParameters()
        self.grid = ObstacleGrid(FOCAL_PX * baseline_m, settings.max_range_m, GridParameters())
        self._lean, self._tilt = Lean(), np.zeros(2)  # of the floor beyond what the rig states; of the tables
        self._leaned_ns: int | None = None  # stamp of the last pair by which the lean was followed
        self._plane: FloorPlane | None = None
        self._visible: Flags | None = None
        self.evidence: ColumnEvidence | None = None  # of the newest pair

    def set_floor(self, T_rect_base: Array, visible: Flags) -> None:
        """Take T_rect_base (4, 4), from the base level on the floor to the panoramas, and their pixels (H, W)."""
        self._plane, self._visible = floor_plane(T_rect_base), visible
        self.grid.set_floor(T_rect_base)
        self._make_tables()

    def add(
        self, stamp_ns: int, T_odom_base: Array, lower: PaddedPanorama, upper: PaddedPanorama, lost: Flags | None
    ) -> GridRing:
        """Return the ring at a pair, whose base has the planar pose T_odom_base (4, 4).

        lost (H, W): pixels that are no evidence, None: all in view are.
        """
        # 1. Evidence, with the look of floor that is known.
        pair = self.columns.panoramas.pair(lower, upper, lost)
        evidence = self.evidence = self.columns.evidence(pair)
        if not self.posterior.shows_floor:
            return unknown_ring()
        known = self.grid.is_floor(T_odom_base, self.posterior.ranges_m, DIRECTIONS)
        belief = self.posterior.belief(pair, evidence, known)
        # 2. The grid.
        ring = self.grid.update(stamp_ns, T_odom_base, belief)
        # 3. The lean of the rig, for the next pair.
        is_due = self._leaned_ns is None or not 0 <= stamp_ns - self._leaned_ns < LEAN_NS
        if is_due or self._lean.sigma.max() > SURE_RAD:
            self._leaned_ns = stamp_ns
            self._observe_lean(T_odom_base, pair)
        return ring

    def _observe_lean(self, T_odom_base: Array, pair: WorkingPair) -> None:
        """Follow the lean by floor that is known; make the tables again where it has changed."""
        assert self._plane is not None
        panoramas, near = self.columns.panoramas, self._lean_rows
        known = np.zeros((panoramas.height, DIRECTIONS), bool)
        known[near] = self.grid.is_floor(T_odom_base, self._row_ranges_m[near], DIRECTIONS) & pair.seen[near]
        px_per_rad = FOCAL_PX * self._baseline_m / self._plane.height_m
        self._lean.observe(pair, panoramas.plane_rows, known, px_per_rad, self._tilt)
        tilt = np.where(self._lean.sigma < SURE_RAD, self._lean.tilt, self._tilt)
        if np.abs(tilt - self._tilt).max() > LEAST_RAD:
            self._tilt = tilt
            self._make_tables()

    def _make_tables(self) -> None:
        """Make the tables of the floor's plane, with its lean."""
        assert self._plane is not None and self._visible is not None
        a, b = self._plane.a + self._tilt[0], self._plane.b + self._tilt[1]
        self.columns = Columns(
            self._cylinder,
            self._baseline_m,
            FloorPlane(self._plane.height_m, float(a), float(b)),
            self._settings.heights_m,
            (NEAREST_M, self._settings.max_range_m),
            self._visible,
        )
        self.posterior = RayPosterior(self.columns, self._plane.height_m, self._baseline_m, self._rays)
        panoramas = self.columns.panoramas
        rows = np.arange(panoramas.height)
        self._row_ranges_m = FOCAL_PX * self._plane.height_m / np.maximum(rows - panoramas.row0, 1e-6)
        in_view = panoramas.plane_rows < self.columns.last_row - 2
        self._lean_rows = np.flatnonzero((self._row_ranges_m < LEAN_M) & in_view)
