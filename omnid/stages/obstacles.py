"""Obstacles of a run: the floor that the rig states, the grid around the base at each pair, and the published scan."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import Final

import numpy as np
from numpy.typing import NDArray

from calib import se3
from calib.panorama import Cylinder
from calib.rig import Rig
from calib.se2_arrays import planar, transform
from omnid.config import ObstaclesConfig
from omnid.core.control.collision_monitor import ControllerScan, MovingPoint
from omnid.core.mapping.range_scan import SECTORS
from omnid.core.nanoseconds import NS_PER_S, STAMP_JITTER_NS
from omnid.core.obstacles.moving_tracker import MovingTracker
from omnid.core.obstacles.ray_scans import RayScans
from omnid.core.stereo.tiles import TILE_COLUMNS, tile_columns
from omnid.messages import ObstacleScan, OdometryUpdate
from omnid.stages.geometry import Geometry
from omnid.tracking_state import TrackingState

Array = NDArray[np.float64]
Flags = NDArray[np.bool_]

FLOOR_WARNING: Final = (
    "the rig has no height of the cameras: obstacles, grid and map are unknown, and nothing is free; state it by "
    "`omnid calibrate drive LOG --only height --rig rig.toml -o rig.toml`"
)


def floor_frame(rig: Rig, floor_m: float) -> Array | None:
    """Return the transform T_floor_rig (4, 4) from the rig to the base frame moved in z, with the floor at z = 0.

    floor_m: height of the floor in the base frame (obstacles.scan.floor_m). None: the rig states no height, so nothing
    may be called free.
    """
    if rig.height_m(floor_m) is None:
        return None
    return np.asarray(se3.transform(np.eye(3), np.array([0.0, 0.0, -floor_m])) @ rig.T_base_rig)


# Scan of a pair while the floor is not known.
UNKNOWN: Final = np.full(SECTORS, np.nan, np.float32)
NOT_FREE: Final = np.zeros(SECTORS, np.float32)


def sectors_of(tiles: Flags, cylinder: Cylinder, T_base_rect: Array, ranges_m: Sequence[float]) -> Flags:
    """Return the sectors (SECTORS,) about the base that columns of tiles (C,) show at ranges [m].

    T_base_rect (4, 4): from the rectified frame to the base; inf: directions from the viewpoint.
    """
    found = np.zeros(SECTORS, bool)
    if not tiles.any():  # as in nearly all pairs
        return found
    width_px = cylinder.width / tile_columns(cylinder)
    across = np.linspace(0.0, 1.0, 2 * SECTORS // TILE_COLUMNS + 1)  # a tile, so that each sector has two samples
    columns = ((np.flatnonzero(tiles)[:, None] + across) * width_px - 0.5).ravel()
    rays = cylinder.rays(np.column_stack([columns, np.full(columns.size, cylinder.row0)]))
    direction = (rays @ T_base_rect[:3, :3].T)[:, :2]
    x, y = np.moveaxis(direction + T_base_rect[:2, 3] / np.array(ranges_m)[:, None, None], -1, 0)
    found[np.floor((np.arctan2(y, x) + math.pi) * (SECTORS / math.tau)).astype(np.intp) % SECTORS] = True
    return found


class Obstacles:
    """Makes a scan of each pair that is due: the obstacle grid of a run, and the obstacles that move in it."""

    def __init__(self, geometry: Geometry, config: ObstaclesConfig) -> None:
        self._geometry = geometry
        self._period_ns = NS_PER_S / config.rate_hz if config.rate_hz else 0.0
        self._T_floor_rig = floor_frame(geometry.rig, config.scan.floor_m)
        self._has_tables = False  # of the floor, which the visible pixels of the first pair make
        self.scans = RayScans(geometry.cylinder, geometry.rig.baseline_m, config.scan)
        self._tracker = MovingTracker()
        self._T_base_rect = geometry.T_base_rect
        # A direction of the cameras is one of the base only far away, because the viewpoint may lie off its origin.
        self._ranges_m = (*(config.scan.max_range_m / 2**k for k in range(6)), math.inf)
        self._last_ns: int | None = None
        self._resets = 0

    def process(self, odometry: OdometryUpdate) -> ObstacleScan | None:
        """Return the scan at a pair, None where it is not due."""
        # At the rate of the configuration; stamps that step back are of another part of a log.
        if self._last_ns is not None and 0 <= odometry.stamp_ns - self._last_ns < self._period_ns - STAMP_JITTER_NS:
            return None
        self._last_ns = odometry.stamp_ns
        return self.scan(odometry)

    def scan(self, odometry: OdometryUpdate) -> ObstacleScan:
        """Add the evidence of a pair; return the scan at it, which is unknown where the floor or the pose is."""
        # 1. Forget the grid and the tracks where odometry has begun again; while it is lost the grid is kept: it is
        #    valid again once odometry recognises its landmarks.
        is_lost = odometry.state is TrackingState.LOST
        if has_reset := odometry.reset_counter != self._resets:
            self.scans.begin_again()
            self._resets = odometry.reset_counter
        if has_reset or is_lost:
            self._tracker = MovingTracker()
        panoramas = odometry.depth.panoramas
        T_odom_base = odometry.of_base(self._geometry.rig.T_base_rig)[0]
        tiles, cylinder = panoramas.tiles, self._geometry.cylinder
        unobserved = sectors_of(tiles.unknown, cylinder, self._T_base_rect, self._ranges_m)
        unknown = ObstacleScan(odometry.seq, odometry.stamp_ns, UNKNOWN, UNKNOWN, NOT_FREE, T_odom_base, (), unobserved)
        # 2. Tables of the floor.
        if is_lost or self._T_floor_rig is None:
            return unknown
        if not self._has_tables:
            self._has_tables = True
            T_rect_floor = self._geometry.rig.T_rect_rig @ se3.inverse(self._T_floor_rig)
            self.scans.set_floor(T_rect_floor, panoramas.visible)
        # 3. The scan by the images, without their dead and blind parts.
        lost = tiles.lost_pixels(panoramas.visible.shape)
        scan = self.scans.add(odometry.stamp_ns, T_odom_base, panoramas.lower, panoramas.upper, lost)
        if scan is None:
            return unknown
        # 4. The moving obstacles.
        is_unknown = sectors_of(tiles.unknown, cylinder, self._T_base_rect, (math.inf,))
        scan.arrivals.ranges_m[is_unknown] = np.nan
        viewpoint = transform(self.scans.grid.viewpoint(planar(T_odom_base)))
        moving = self._tracker.update(odometry.stamp_ns, viewpoint, scan.arrivals)
        # 5. Directions in which the images show nothing to rely on are unknown.
        return replace(
            unknown,
            ranges_m=np.where(unobserved, UNKNOWN, scan.ranges_m),
            sigma_m=np.where(unobserved, UNKNOWN, scan.sigma_m),
            free_m=np.where(unobserved, NOT_FREE, scan.free_m),
            moving=moving,
            grid=scan.grid,
        )


def controller_scan(scan: ObstacleScan) -> ControllerScan:
    """Return the part of a scan that the controller needs: ranges less their sigma, moving obstacles in base axes."""
    nearest = np.where(np.isfinite(scan.ranges_m), scan.ranges_m - np.nan_to_num(scan.sigma_m), scan.ranges_m)
    T = transform(planar(scan.T_odom_base))
    moving = []
    for obstacle in scan.moving:
        x, y = (np.array([obstacle.x_m, obstacle.y_m]) - T[:2, 3]) @ T[:2, :2]
        vx, vy = np.array([obstacle.vx_mps, obstacle.vy_mps]) @ T[:2, :2]
        sigmas = (math.sqrt(np.diag(obstacle.covariance)[part].max()) for part in (slice(2), slice(2, 4)))
        moving.append(MovingPoint(float(x), float(y), float(vx), float(vy), obstacle.radius_m, *sigmas))
    return ControllerScan(
        scan.stamp_ns,
        tuple(np.maximum(nearest, 0.0).tolist()),
        tuple(scan.free_m.tolist()),
        tuple(moving),
        tuple(scan.unobserved.tolist()) if scan.unobserved.any() else (),
    )
