"""Obstacle stage: ring of the nearest obstacles around the base, from the columns of pairs."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Final

import numpy as np
from numpy.typing import NDArray

from calib import se3
from calib.se2_arrays import planar, transform
from omnid.config import ObstaclesConfig
from omnid.core.control.controller_ring import ControllerRing, MovingPoint
from omnid.core.floor import Floor
from omnid.core.frames import of_base
from omnid.core.mapping.range_scan import SECTORS
from omnid.core.obstacles.column import NEAREST_M, Columns, floor_plane
from omnid.core.obstacles.grid import ObstacleGrid
from omnid.core.obstacles.moving_tracker import MovingTracker
from omnid.core.obstacles.pair_views import FOCAL_PX
from omnid.core.obstacles.unwatched import Unwatched, without
from omnid.load_level import Load, LoadLevel, full_load
from omnid.messages import ObstacleRing, OdometryUpdate, Panoramas
from omnid.stages.dense_depths import DenseDepths
from omnid.stages.floor import CameraFloor
from omnid.stages.geometry import Geometry
from omnid.stages.mapping import STAMP_JITTER_NS
from omnid.tracking_state import TrackingState

Array = NDArray[np.float64]

# Ring of a pair while the floor is not known.
UNKNOWN: Final = np.full(SECTORS, np.nan, np.float32)
NOT_FREE: Final = np.zeros(SECTORS, np.float32)
# Least time between two rings; with the time from images to ring it stays below controller.collision.stale_s.
SHED_PERIOD_NS: Final[Mapping[LoadLevel, int]] = {
    LoadLevel.FULL: 0,
    LoadLevel.SPARSE_MAP: 0,
    LoadLevel.NO_MAP: 250_000_000,
    LoadLevel.REDUCED: 300_000_000,
}


class Obstacles:
    """Makes a ring of each pair that is due, from the evidence of its columns."""

    def __init__(self, geometry: Geometry, config: ObstaclesConfig, dense: DenseDepths, load: Load = full_load) -> None:
        """dense: computes the depth of a pair, from which a floor is found that the rig does not state."""
        self._load, self._dense, self._geometry = load, dense, geometry
        self._period_ns = 1e9 / config.rate_hz if config.rate_hz else 0.0
        self._settings = config.ring
        self.floor = CameraFloor(geometry.rig, config.ring.floor_m)
        self._of_floor: Floor | None = None  # floor for which the columns were made
        self._columns: Columns | None = None
        self._grid = ObstacleGrid(FOCAL_PX * geometry.rig.baseline_m, config.ring)
        self._tracker = MovingTracker()
        self._unwatched = Unwatched(geometry.cylinder, geometry.rig.T_base_rig @ geometry.T_rig_rect)
        self._last_ns: int | None = None
        self._resets = 0

    def process(self, odometry: OdometryUpdate) -> ObstacleRing | None:
        """Return the ring at a pair, None where it is not due."""
        # 1. Forget the grid and the tracks where odometry has begun again.
        if not self._is_due(odometry):
            return None
        self._last_ns = odometry.stamp_ns
        if odometry.reset_counter != self._resets:
            self._grid.begin_again()
            self._tracker.clear()
            self._resets = odometry.reset_counter
        panoramas = odometry.depth.panoramas
        T_odom_base = of_base(odometry, self._geometry.rig.T_base_rig)[0]
        unwatched = self._unwatched.sectors(panoramas.tiles.unknown)
        unknown = ObstacleRing(odometry.seq, odometry.stamp_ns, UNKNOWN, UNKNOWN, NOT_FREE, T_odom_base, (), unwatched)
        if odometry.state is TrackingState.LOST:
            # The place is not known. What is known in odom holds again when odometry finds its landmarks again.
            self._tracker.clear()
            return unknown
        # 2. The floor; while it is unknown, so is the ring.
        if self.floor.wants_points:
            # As they were matched: the fit leaves out by itself what is no floor.
            self.floor.add(self._dense.points(odometry.depth.panoramas, odometry.depth.exposure))
        columns = self._columns_of(self.floor.floor, panoramas)
        if columns is None:
            return unknown
        # 3. The evidence of the images without their dead and blind parts, where nothing is watched any longer.
        lost = panoramas.tiles.lost_pixels(panoramas.visible.shape)
        evidence = columns.evidence(panoramas.lower, panoramas.upper, lost)
        # 4. The grid, its ring, and the obstacles that move.
        pose = transform(planar(T_odom_base))
        unseen = self._unwatched.directions(panoramas.tiles.unknown)
        ring = without(self._grid.update(odometry.stamp_ns, pose, evidence), unwatched, unseen)
        moving = self._tracker.update(odometry.stamp_ns, self._grid.viewpoint(pose), ring.arrivals)
        return ObstacleRing(
            odometry.seq, odometry.stamp_ns, ring.ranges_m, ring.sigma_m, ring.free_m, T_odom_base, moving, unwatched
        )

    def _columns_of(self, floor: Floor | None, panoramas: Panoramas) -> Columns | None:
        """Return the columns for a floor, None without one; all panoramas of a run show the same part of the world."""
        if floor is not None and floor is not self._of_floor:
            geometry, settings = self._geometry, self._settings
            T_rect_floor = geometry.rig.T_rect_rig @ se3.inverse(self.floor.T_floor_rig(floor))
            plane = floor_plane(T_rect_floor)
            self._of_floor = floor
            self._columns = Columns(
                geometry.cylinder,
                geometry.rig.baseline_m,
                plane,
                settings.heights_m,
                (NEAREST_M, settings.max_range_m),
                panoramas.visible,
            )
            self._grid.set_floor(T_rect_floor, plane.height_m)
        return self._columns

    def _is_due(self, odometry: OdometryUpdate) -> bool:
        """True if a pair is to give a ring."""
        if self._last_ns is None:
            return True
        wait_ns = max(self._period_ns, SHED_PERIOD_NS[self._load()])
        since_ns = odometry.stamp_ns - self._last_ns
        return since_ns < 0 or since_ns >= wait_ns - STAMP_JITTER_NS


def controller_ring(ring: ObstacleRing) -> ControllerRing:
    """Return the part of a ring that the controller needs: ranges less their sigma, moving obstacles in base axes."""
    nearest = np.where(np.isfinite(ring.ranges_m), ring.ranges_m - np.nan_to_num(ring.sigma_m), ring.ranges_m)
    T = transform(planar(ring.T_odom_base))
    moving = []
    for obstacle in ring.moving:
        x, y = (np.array([obstacle.x_m, obstacle.y_m]) - T[:2, 3]) @ T[:2, :2]
        vx, vy = np.array([obstacle.vx_mps, obstacle.vy_mps]) @ T[:2, :2]
        sigmas = (math.sqrt(np.diag(obstacle.covariance)[part].max()) for part in (slice(2), slice(2, 4)))
        moving.append(MovingPoint(float(x), float(y), float(vx), float(vy), obstacle.radius_m, *sigmas))
    return ControllerRing(
        ring.stamp_ns,
        tuple(np.maximum(nearest, 0.0).tolist()),
        tuple(ring.free_m.tolist()),
        tuple(moving),
        tuple(ring.unwatched.tolist()) if ring.unwatched.any() else (),
    )
