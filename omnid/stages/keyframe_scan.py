"""Range scan of a keyframe: the nearest obstacles above the floor by the height of its points, and the free floor."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from calib import se3
from omnid.core.mapping.point_scan import ScanLimits, point_scan
from omnid.core.mapping.range_scan import MAX_RANGE_M, SECTORS, FreeRanges, RangeScan, seen_from
from omnid.core.obstacles.settings import RingSettings
from omnid.messages import DensePoints, ObstacleRing
from omnid.stages.obstacles import CameraFloor

Array = NDArray[np.float64]


def keyframe_scan(
    depth: DensePoints, camera_floor: CameraFloor, T_rig_rect: Array, settings: RingSettings
) -> RangeScan:
    """Return the ranges (SECTORS,) by azimuth in the rectified frame, turned level; all unknown without a floor."""
    floor = camera_floor.floor
    if floor is None:
        return np.full(SECTORS, np.nan, np.float32)
    T_floor_rig = camera_floor.T_floor_rig(floor)
    T_floor_rect = T_floor_rig @ T_rig_rect
    points = se3.apply(_T_level_floor(T_floor_rect) @ T_floor_rig, depth.points)
    view = np.array([0.0, 0.0, T_floor_rect[2, 3]])
    limits = ScanLimits(settings.heights_m, math.radians(settings.tilt_deg), MAX_RANGE_M, settings.min_points)
    ranges = point_scan(points, np.sqrt(depth.variance_m2), view, limits, floor.sigma_m)
    return np.where(np.isfinite(ranges), ranges, np.float32(np.nan))


def keyframe_free(ring: ObstacleRing, narrow_m: FreeRanges, camera_floor: CameraFloor, T_rig_rect: Array) -> FreeRanges:
    """Return up to where the floor is free by the ring at a keyframe, (SECTORS,) as of its scan.

    narrow_m (SECTORS,): where something narrow may begin to hide the floor, inf: nowhere; there they are negative.
    """
    floor = camera_floor.floor
    if floor is None:
        return np.zeros(SECTORS, np.float32)
    free_m = seen_from(ring.free_m, _T_level_floor(camera_floor.T_floor_rig(floor) @ T_rig_rect))
    free_m = np.minimum(free_m, np.float32(MAX_RANGE_M))
    return np.where(np.isfinite(narrow_m), -np.minimum(free_m, narrow_m), free_m)


def _T_level_floor(T_floor_rect: Array) -> Array:
    """Return the transform to the level frame below the lower viewpoint, with the heading of the rectified frame."""
    heading = se3.rotation_exp(np.array([0.0, 0.0, float(se3.yaw(T_floor_rect))]))
    return se3.inverse(se3.transform(heading, np.array([*T_floor_rect[:2, 3], 0.0])))
