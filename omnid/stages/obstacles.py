"""Obstacle stage: ring of the nearest obstacles around the base, from the columns of pairs."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Final

import numpy as np

from calib.se2_arrays import planar, transform
from omnid.config import ObstaclesConfig
from omnid.core.control.collision_monitor import ControllerRing, MovingPoint
from omnid.load_level import Load, LoadLevel, full_load
from omnid.messages import ObstacleRing, OdometryUpdate
from omnid.stages.dense_depths import DenseDepths
from omnid.stages.floor import CameraFloor
from omnid.stages.geometry import Geometry
from omnid.stages.mapping import STAMP_JITTER_NS
from omnid.stages.pair_rings import PairRings
from omnid.tracking_state import TrackingState

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
        self._load, self._dense = load, dense
        self._period_ns = 1e9 / config.rate_hz if config.rate_hz else 0.0
        self.floor = CameraFloor(geometry.rig, config.ring.floor_m)
        self._rings = PairRings(geometry, config.ring)
        self._last_ns: int | None = None

    @property
    def fixed_share(self) -> float:
        """Return the share of the panoramas that shows what is fixed to a camera."""
        return self._rings.fixed.share

    def process(self, odometry: OdometryUpdate) -> ObstacleRing | None:
        """Return the ring at a pair, None where it is not due."""
        if not self._is_due(odometry):
            return None
        self._last_ns = odometry.stamp_ns
        # 1. The floor, from points of pairs whose pose is known, until it is known.
        if self.floor.wants_points and odometry.state is not TrackingState.LOST:
            # As they were matched: the fit leaves out by itself what is no floor.
            self.floor.add(self._dense.points(odometry.depth.panoramas, odometry.depth.exposure))
        # 2. The ring.
        return self._rings.add(odometry, self.floor)

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
