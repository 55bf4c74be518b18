"""Obstacle stage: ring of the nearest obstacles around the base, from the depth of pairs."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from functools import partial
from typing import Final

import numpy as np
from numpy.typing import NDArray

from calib import se3
from calib.se2_arrays import planar, transform
from omnid.config import ObstaclesConfig
from omnid.core.control.collision_monitor import ControllerRing, MovingPoint
from omnid.core.frames import of_base
from omnid.core.obstacles.floor_plane import FloorPlane
from omnid.core.obstacles.floor_view import FloorCamera, unmeasured
from omnid.core.obstacles.moving_tracker import MovingTracker
from omnid.core.obstacles.observation import observe, with_plane
from omnid.core.obstacles.ring_filter import RingFilter
from omnid.core.obstacles.settings import RingSettings
from omnid.core.obstacles.unwatched import Unwatched, without
from omnid.load_level import Load, LoadLevel, full_load
from omnid.messages import ObstacleRing, OdometryUpdate, Panoramas
from omnid.stages.dense_depths import DenseDepths
from omnid.stages.geometry import Geometry
from omnid.stages.mapping import STAMP_JITTER_NS
from omnid.tracking_state import TrackingState

Array = NDArray[np.float64]


ASSUMED_HEIGHT_M: Final = 1.1  # of the cameras, where the rig's T_base_rig does not say it
LEAST_HEIGHT_M: Final = 0.1  # of the cameras over the floor, in a T_base_rig that says it
# Least time between two rings; with the time from images to ring it stays below controller.collision.stale_s.
SHED_PERIOD_NS: Final[Mapping[LoadLevel, int]] = {
    LoadLevel.FULL: 0, LoadLevel.SPARSE_MAP: 0, LoadLevel.NO_MAP: 250_000_000, LoadLevel.REDUCED: 300_000_000}


def ring_settings(geometry: Geometry, config: ObstaclesConfig) -> RingSettings:
    """Return the settings with the height of the floor; where the base is the rig itself, with an assumed one."""
    if not floor_is_assumed(geometry, config):
        return config.ring
    return replace(config.ring, floor_m=viewpoint(geometry)[2] - ASSUMED_HEIGHT_M)


def floor_is_assumed(geometry: Geometry, config: ObstaclesConfig) -> bool:
    """True if T_base_rig has the cameras on the floor, as one that was never measured."""
    return bool(viewpoint(geometry)[2] - config.ring.floor_m < LEAST_HEIGHT_M)


def viewpoint(geometry: Geometry) -> Array:
    """Return the lower viewpoint (3,) in the base frame."""
    return np.asarray((geometry.rig.T_base_rig @ geometry.T_rig_rect)[:3, 3])


class Obstacles:
    """Makes a ring of each pair that is due; dense stereo of a pair is shared with the map."""

    def __init__(self, geometry: Geometry, config: ObstaclesConfig, dense: DenseDepths, load: Load = full_load) -> None:
        """dense: computes the depth of a pair that is due."""
        self._T_base_rig = geometry.rig.T_base_rig
        self._load, self._dense = load, dense
        self._period_ns = 1e9 / config.rate_hz if config.rate_hz else 0.0
        self._settings = ring_settings(geometry, config)
        self._filter, self._tracker = RingFilter(self._settings), MovingTracker()
        self._view = viewpoint(geometry)
        self._geometry = geometry
        self._T_rect_base = geometry.rig.T_rect_rig @ se3.inverse(geometry.rig.T_base_rig)
        self._floor = FloorCamera(geometry.cylinder, self._T_rect_base, self._settings.floor_m)
        self._unwatched = Unwatched(geometry.cylinder, geometry.rig.T_base_rig @ geometry.T_rig_rect)
        self._plane: FloorPlane | None = None
        self._is_measured = not floor_is_assumed(geometry, config)  # else no plane is known that pixels could show
        self._last_ns: int | None = None
        self._resets = 0

    def process(self, odometry: OdometryUpdate) -> ObstacleRing | None:
        """Return the ring at a pair, None where it is not due."""
        if not self._is_due(odometry):
            return None
        self._last_ns = odometry.stamp_ns
        if odometry.state is TrackingState.LOST or odometry.reset_counter != self._resets:
            # Their memory is in odom, which has lost its relation to the robot.
            self._filter.clear()
            self._tracker.clear()
            self._resets = odometry.reset_counter
        depth = self._dense.of(odometry.depth)
        points = se3.apply(self._T_base_rig, depth.points)
        seen = observe(points, np.sqrt(depth.variance_m2), self._view, self._settings)
        panoramas, view = odometry.depth.panoramas, partial(unmeasured, seen.floor_from_m)
        if self._is_measured:
            seen = with_plane(seen, self._plane_of(panoramas).free_m(panoramas.lower, panoramas.upper))
            view = partial(self._floor.view, panoramas.lower, panoramas.usable)
        # What dead and blind parts of the images show is no evidence, and what was known there is no longer watched.
        unwatched = self._unwatched.sectors(panoramas.tiles.unknown)
        seen = without(seen, unwatched)
        T_odom_base = of_base(odometry, self._T_base_rig)[0]
        pose = transform(planar(T_odom_base))
        ring = without(self._filter.update(odometry.stamp_ns, pose, seen, view), unwatched)
        moving = self._tracker.update(odometry.stamp_ns, pose, seen.ranges_m, seen.sigma_m)
        return ObstacleRing(odometry.seq, odometry.stamp_ns, ring.ranges_m, ring.sigma_m, ring.free_m, T_odom_base,
                            moving, unwatched)

    def _plane_of(self, panoramas: Panoramas) -> FloorPlane:
        """Return the plane of the floor in panoramas; all of a run show the same part of the world."""
        if self._plane is None:
            geometry = self._geometry
            self._plane = FloorPlane(geometry.cylinder, self._T_rect_base, self._settings.floor_m,
                                     geometry.rig.baseline_m, panoramas.visible)
        return self._plane

    def _is_due(self, odometry: OdometryUpdate) -> bool:
        """True if a pair is to give a ring: at the rate, and for a keyframe, whose depth is there, after half of it."""
        if self._last_ns is None:
            return True
        wait_ns = max(self._period_ns, SHED_PERIOD_NS[self._load()])
        since_ns = odometry.stamp_ns - self._last_ns
        return since_ns < 0 or since_ns >= (wait_ns / 2 if odometry.is_keyframe else wait_ns) - STAMP_JITTER_NS


def controller_ring(ring: ObstacleRing) -> ControllerRing:
    """Return the part of a ring that the controller needs: ranges less their sigma, moving obstacles in base axes."""
    nearest = np.where(np.isfinite(ring.ranges_m), ring.ranges_m - np.nan_to_num(ring.sigma_m), ring.ranges_m)
    T = transform(planar(ring.T_odom_base))
    moving = []
    for obstacle in ring.moving:
        x, y = (np.array([obstacle.x_m, obstacle.y_m]) - T[:2, 3]) @ T[:2, :2]
        vx, vy = np.array([obstacle.vx_mps, obstacle.vy_mps]) @ T[:2, :2]
        moving.append(MovingPoint(float(x), float(y), float(vx), float(vy), obstacle.radius_m))
    return ControllerRing(ring.stamp_ns, tuple(np.maximum(nearest, 0.0).tolist()), tuple(ring.free_m.tolist()),
                          tuple(moving), tuple(ring.unwatched.tolist()) if ring.unwatched.any() else ())
