"""Views of a map of places: its landmarks, its grid and its paths, in the axes of the robot's base at the start."""

from __future__ import annotations

from collections.abc import Set
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from calib import se3
from omnid.core.mapping.occupancy_grid import Grid
from omnid.core.mapping.scan_grid import ScanGrid, scan_grid
from omnid.core.mapping.voxel_map import MapPoints, VoxelMap
from omnid.core.places.place_map import PlaceMap
from omnid.core.places.place_rig import PlaceRig
from omnid.core.stereo.triangulation import triangulate

Array = NDArray[np.float64]

SIGMA_PX: Final = 0.3  # standard deviation of a disparity; by trial on development seeds
MAX_SIGMA_M: Final = 0.3  # largest standard deviation of a landmark that is shown; by trial on development seeds
VOXEL_M: Final = 0.05  # Side of the voxels in which landmarks of several keyframes are fused; as in the grids.


@dataclass(frozen=True, slots=True)
class PlaceSummary:
    """Sizes of a map of places."""

    keyframes: int
    sessions: int
    features: int
    loops: int
    dropped: int  # keyframes that were dropped because the map was full
    parts: int  # number of parts that no link joins; 1: all is one map
    path_m: float  # length of the links of odometry
    extent_m: tuple[float, float]  # along x and y
    tags: int  # number of tags in the map
    tags_seen: int
    first_stamp_ns: int
    last_stamp_ns: int


def summary(places: PlaceMap, rig: PlaceRig) -> PlaceSummary:
    """Return the sizes of a map."""
    keyframes = [places.keyframes[id] for id in sorted(places.keyframes)]
    xy = base_poses(places, rig)[:, :2, 3]
    extent = np.ptp(xy, axis=0) if len(xy) else np.zeros(2)
    stamps = [keyframe.stamp_ns for keyframe in keyframes] or [0]
    return PlaceSummary(
        len(keyframes),
        len({keyframe.session for keyframe in keyframes}),
        sum(keyframe.features.count for keyframe in keyframes),
        places.loops,
        places.dropped,
        len(parts(places)),
        float(sum(np.linalg.norm(link.T_a_b[:3, 3]) for link in places.links if not link.is_loop)),
        (float(extent[0]), float(extent[1])),
        len(places.tags.known),
        len({view.tag for view in places.tags.views}),
        min(stamps),
        max(stamps),
    )


def parts(places: PlaceMap) -> list[list[int]]:
    """Return the ids of the keyframes that links join, part by part, the largest first."""
    part_of = {id: {id} for id in sorted(places.keyframes)}
    for link in places.links:
        a, b = part_of[link.a], part_of[link.b]
        if a is not b:
            small, large = sorted((a, b), key=len)
            large |= small
            part_of.update(dict.fromkeys(small, large))
    different = {id(part): sorted(part) for part in part_of.values()}
    return sorted(different.values(), key=lambda ids: (-len(ids), ids[0]))


def keep_only(places: PlaceMap, ids: Set[int]) -> None:
    """Remove all other keyframes from a map, and their links."""
    places.links = [link for link in places.links if link.a in ids and link.b in ids]
    for id in places.keyframes.keys() - ids:
        del places.keyframes[id], places.poses[id]
        places.uses.pop(id, None)
    places.tags = places.tags.part(ids)


def base_poses(places: PlaceMap, rig: PlaceRig) -> Array:
    """Return the poses (K, 4, 4) of the base at the keyframes, in the base's axes at the start of the map."""
    return _of_base(np.array([places.poses[id] for id in sorted(places.keyframes)]), rig)


@dataclass(frozen=True, slots=True, eq=False)
class MappedDrive:
    """Keyframes in the order of a drive, with the poses (K, 4, 4) of the base in its axes at the start of the map."""

    session: int
    ids: list[int]
    T_map_base: Array
    T_by_odometry: Array  # the same, if odometry alone had gone on from the first keyframe


def drives(places: PlaceMap, rig: PlaceRig) -> list[MappedDrive]:
    """Return the drives of a map; one ends where the session does, or where odometry lost its pose."""
    joined = {(min(link.a, link.b), max(link.a, link.b)) for link in places.links if not link.is_loop}
    parts: list[list[int]] = []
    for id in sorted(places.keyframes):
        last = parts[-1][-1] if parts else -1
        same = last >= 0 and places.keyframes[last].session == places.keyframes[id].session and (last, id) in joined
        if same:
            parts[-1].append(id)
        else:
            parts.append([id])
    return [_drive(places, ids, rig) for ids in parts]


def paths_xy(places: PlaceMap, rig: PlaceRig) -> Array:
    """Return the paths (N, 2) [m] of all drives, a row of NaN after each, as nothing drove from one to the next."""
    paths = [np.vstack([drive.T_map_base[:, :2, 3], np.full((1, 2), np.nan)]) for drive in drives(places, rig)]
    return np.vstack([np.zeros((0, 2)), *paths])


def _drive(places: PlaceMap, ids: list[int], rig: PlaceRig) -> MappedDrive:
    T_odom = np.array([places.keyframes[id].T_odom_rect for id in ids])
    by_odometry = places.poses[ids[0]] @ se3.inverse(T_odom[0]) @ T_odom
    corrected = np.array([places.poses[id] for id in ids])
    return MappedDrive(places.keyframes[ids[0]].session, ids, _of_base(corrected, rig), _of_base(by_odometry, rig))


def _of_base(T_map_rect: Array, rig: PlaceRig) -> Array:
    """Return poses (K, 4, 4) of the base, in its axes at the start of the map."""
    return np.asarray(rig.T_base_rect @ T_map_rect.reshape(-1, 4, 4) @ se3.inverse(rig.T_base_rect))


def grid(places: PlaceMap, rig: PlaceRig, cell_m: float) -> Grid:
    """Return the occupancy grid of the keyframes' range scans and free floor, the newest evidence last."""
    return scans_of(places, rig, cell_m).grid()


def scans_of(places: PlaceMap, rig: PlaceRig, cell_m: float) -> ScanGrid:
    """Return what the grid is made of."""
    ids = sorted(places.keyframes, key=lambda id: (places.keyframes[id].session, places.keyframes[id].stamp_ns, id))
    poses = np.array([rig.T_base_rect @ places.poses[id] for id in ids]).reshape(-1, 4, 4)
    scans = [places.keyframes[id].scan.astype(np.float32) for id in ids]
    free_m = [places.keyframes[id].free_m.astype(np.float32) for id in ids]
    return scan_grid(scans, free_m, poses, cell_m)


def landmarks(places: PlaceMap, rig: PlaceRig) -> MapPoints:
    """Return the landmarks of all keyframes, fused in voxels."""
    count = sum(keyframe.features.count for keyframe in places.keyframes.values())
    fused = VoxelMap(VOXEL_M, 1 << max(4, (2 * count).bit_length()))
    for id in sorted(places.keyframes):
        points = triangulate(places.keyframes[id].features.loaded().views.astype(float), rig.cylinder, rig.baseline_m)
        radius = np.hypot(points[:, 0], points[:, 1])
        sigma_m = SIGMA_PX * radius**2 / (rig.cylinder.focal_px * rig.baseline_m)
        sure = sigma_m < MAX_SIGMA_M
        fused.insert(se3.apply(rig.T_base_rect @ places.poses[id], points[sure]), sigma_m[sure] ** 2, id)
    return fused.points(min_frames=1)
