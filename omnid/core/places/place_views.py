"""Views of a map of places: its landmarks, its grid and its paths, in the axes of the robot's base at the start."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from calib import se3
from omnid.core.mapping.range_scan import MAX_RANGE_M
from omnid.core.mapping.scan_grid import MAX_CELLS, Grid, KeyframeGrid
from omnid.core.mapping.voxel_map import MapPoints, VoxelMap
from omnid.core.places.place_map import PlaceMap, PlaceRig
from omnid.core.places.pose_graph import connected
from omnid.core.places.recognition import SIGMA_PX
from omnid.core.stereo.triangulation import triangulate

Array = NDArray[np.float64]


def paths_xy(places: PlaceMap, rig: PlaceRig) -> Array:
    """Return the paths (N, 2) [m] of all drives, a row of NaN after each; a reset of odometry begins another drive."""
    rows = [np.zeros((0, 2))]
    session = {id: keyframe.session for id, keyframe in places.keyframes.items()}
    by_odometry = [(link.a, link.b) for link in places.links if not link.is_loop and session[link.a] == session[link.b]]
    for ids in sorted(connected(list(places.keyframes), by_odometry)):
        rows += [_of_base(np.array([places.poses[id] for id in ids]), rig)[:, :2, 3], np.full((1, 2), np.nan)]
    return np.vstack(rows)


def loops_xy(places: PlaceMap, rig: PlaceRig) -> Array:
    """Return the ends (L, 2, 2) [m] of the loops."""
    ends = [[places.poses[link.a], places.poses[link.b]] for link in places.links if link.is_loop]
    return _of_base(np.array(ends), rig)[:, :2, 3].reshape(-1, 2, 2)


def _of_base(T_map_rect: Array, rig: PlaceRig) -> Array:
    """Return poses (K, 4, 4) of the base, in its axes at the start of the map."""
    return np.asarray(rig.T_base_rect @ T_map_rect.reshape(-1, 4, 4) @ se3.inverse(rig.T_base_rect))


def grid(places: PlaceMap, rig: PlaceRig, cell_m: float) -> Grid:
    """Return the occupancy grid of the keyframes' range scans and free floor, the newest evidence last."""
    ids = sorted(places.keyframes, key=lambda id: (places.keyframes[id].session, places.keyframes[id].stamp_ns, id))
    return KeyframeGrid(cell_m, MAX_CELLS).draw(places.scans(ids), rig.T_base_rect)


def landmarks(places: PlaceMap, rig: PlaceRig, voxel_m: float) -> MapPoints:
    """Return the landmarks of all keyframes up to MAX_RANGE_M, fused in voxels of voxel_m [m]."""
    count = sum(len(keyframe.features.views) for keyframe in places.keyframes.values())
    fused = VoxelMap(voxel_m, count)
    for id in sorted(places.keyframes):
        points = triangulate(places.keyframes[id].features.views.astype(float), rig.cylinder, rig.baseline_m)
        radius = np.hypot(points[:, 0], points[:, 1])
        sigma_m = SIGMA_PX * radius**2 / (rig.cylinder.focal_px * rig.baseline_m)
        sure = radius < MAX_RANGE_M
        fused.insert(se3.apply(rig.T_base_rect @ places.poses[id], points[sure]), sigma_m[sure] ** 2, id)
    return fused.points(min_frames=1)
