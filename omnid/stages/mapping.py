"""Maps of a run: voxels (Dang et al. 2012, section IV.G), the map of places, and its grid."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence

import numpy as np
from numpy.typing import NDArray

from calib import se3
from omnid.config import Config, MappingConfig
from omnid.core.frames import carried
from omnid.core.mapping.range_scan import MAX_RANGE_M, SECTORS, FreeRanges, RangeScan, point_scan, seen_from
from omnid.core.mapping.scan_grid import KeyframeGrid
from omnid.core.mapping.voxel_map import ThinnedPath, VoxelMap
from omnid.core.nanoseconds import NS_PER_S, STAMP_JITTER_NS
from omnid.core.obstacles.settings import ScanSettings
from omnid.core.places.localisation import SEARCHES, MapLocaliser, OdometryFrame
from omnid.core.places.place_map import PlaceMap
from omnid.messages import DensePoints, GridUpdate, MapKeyframes, MapUpdate, ObstacleScan, OdometryUpdate, PlaceUpdate
from omnid.stages.geometry import DenseDepths, Geometry, stereo_frame
from omnid.stages.obstacles import Obstacles, floor_frame
from omnid.tracking_state import MapState, TrackingState

Array = NDArray[np.float64]

# A voxel is published if enough of the mapped frames have seen it: a tenth of them, from two (half of the frames where
# there are fewer than 4) to mapping.min_frames.
FRAMES_PER_VOXEL_FRAME = 10
# A pair that has moved by less shows the same points again. Measured: with 15 cm and 8 degrees half as many pairs enter
# the map, but up to 2.4 times as many of its points are wrong (`tests.bench.accuracy --cloud`).
SAME_VIEW_M, SAME_VIEW_TRACE = 0.03, 3 - math.radians(2) ** 2
SAME_VIEW_NS = NS_PER_S  # Least time between two pairs of the same view that enter the map.


class Mapping:
    """Fuses points of small variance at tracked poses; returns the map periodically and at the end."""

    def __init__(
        self, config: MappingConfig, dense: DenseDepths, every_s: float = 0.0, *, keyframes_only: bool = False
    ) -> None:
        """dense: computes the depth of a pair that enters the map; keyframes_only: others do not enter it.

        every_s: time between two maps, by the stamps; 0: one map, at the end.
        """
        self._config, self._dense, self._keyframes_only = config, dense, keyframes_only
        self._every_ns, self._published_ns = round(every_s * NS_PER_S), 0
        self._map = VoxelMap(config.voxel_m, config.max_voxels)
        self._path = ThinnedPath(config.path_poses, config.voxel_m)
        self._newest: OdometryUpdate | None = None
        self._min_gap_ns = round(NS_PER_S / config.rate_hz) if config.rate_hz else 0
        self._mapped: tuple[int, Array] | None = None  # stamp and pose of the last pair that entered the map
        self._frames = 0  # number of pairs that entered the map

    def process(self, odometry: OdometryUpdate) -> MapUpdate | None:
        """Add the points of a pair; return the map when it is due."""
        # 1. The path has all poses, the map the points of those pairs that are due.
        self._newest = odometry
        self._path.add(*odometry.T_odom_rig[:2, 3].tolist())
        if odometry.state == TrackingState.TRACKING and self._is_due(odometry):
            self._mapped = odometry.stamp_ns, odometry.T_odom_rig
            self._frames += 1
            depth = self._dense.of(odometry.depth)
            sure = depth.variance_m2 < self._config.max_sigma_m**2
            points = se3.apply(odometry.T_odom_rig, depth.points[sure])
            self._map.insert(points, depth.variance_m2[sure], odometry.seq)
        # 2. The map, where a period has passed since the last one.
        if not self._every_ns or odometry.stamp_ns - self._published_ns < self._every_ns:
            return None
        self._published_ns = odometry.stamp_ns
        return self._update(odometry)

    def finish(self) -> list[MapUpdate]:
        """Return the final map, if there was a pair."""
        return [] if self._newest is None else [self._update(self._newest)]

    def _is_due(self, odometry: OdometryUpdate) -> bool:
        """True if a pair is to enter the map: at mapping.rate_hz, or once a second while the view is the same.

        Dense stereo costs as much as the odometry of a pair. A keyframe, whose dense stereo the odometry needs anyway,
        is due after half the time, which saves that of another pair.
        """
        if self._keyframes_only and not odometry.is_keyframe:
            return False
        if self._mapped is None or not self._min_gap_ns:
            return True
        since_ns, moved = odometry.stamp_ns - self._mapped[0], se3.inverse(self._mapped[1]) @ odometry.T_odom_rig
        is_same_view = np.linalg.norm(moved[:3, 3]) < SAME_VIEW_M and np.trace(moved[:3, :3]) > SAME_VIEW_TRACE
        wait_ns = max(self._min_gap_ns, SAME_VIEW_NS if is_same_view else 0)
        return since_ns >= (wait_ns / 2 if odometry.is_keyframe else wait_ns) - STAMP_JITTER_NS

    def _update(self, newest: OdometryUpdate) -> MapUpdate:
        """Return the path, and the voxels that enough frames have seen: false matches seldom repeat in one place."""
        least = min(2, max(1, self._frames // 2))
        enough = min(self._config.min_frames, max(least, self._frames // FRAMES_PER_VOXEL_FRAME))
        return MapUpdate(newest.seq, newest.stamp_ns, self._map.points(enough), self._path.xy())


class MapGrid:
    """Draws the grid of the map periodically and at the end, if the map has changed."""

    def __init__(self, cell_m: float, T_base_rect: Array, every_s: float = 0.0) -> None:
        """cell_m: side of a cell. every_s: time between two grids, by the stamps; 0: one grid, at the end."""
        self._grid, self._T_base_rect = KeyframeGrid(cell_m), T_base_rect
        self._every_ns, self._drawn_ns = round(every_s * NS_PER_S), 0
        self._drawn: object = None  # scans of the last grid
        self._newest: PlaceUpdate | None = None

    def process(self, update: PlaceUpdate) -> GridUpdate | None:
        """Return the grid when it is due and has changed."""
        if not update.is_known:  # the pose of these scans in the map is unknown
            return None
        self._newest = update
        is_due = self._every_ns and update.stamp_ns - self._drawn_ns >= self._every_ns
        return self._update(update) if is_due else None

    def finish(self) -> Iterator[GridUpdate]:
        """Yield the final grid, if it has changed."""
        if self._newest is not None and (final := self._update(self._newest)) is not None:
            yield final

    def _update(self, newest: PlaceUpdate) -> GridUpdate | None:
        if newest.scans is None or not newest.scans.scans or newest.scans is self._drawn:
            return None
        self._drawn_ns, self._drawn = newest.stamp_ns, newest.scans
        return GridUpdate(newest.seq, newest.stamp_ns, self._grid.draw(newest.scans, self._T_base_rect))


class Places:
    """Localise the poses of odometry in a map of places, which grows with them.

    The map belongs to the thread of this stage until the run ends.
    """

    def __init__(self, geometry: Geometry, config: Config, dense: DenseDepths, places: PlaceMap | None = None) -> None:
        """dense: computes the depth of keyframes. places: a map to be extended, None: a new one."""
        self._dense = dense
        model, settings = geometry.model(config.odometry.noise_px), config.places
        self._localiser = MapLocaliser(model, settings.limits, places, localize_only=settings.localize_only)
        self._T_rig_rect = geometry.T_rig_rect
        self._T_rect_rig = se3.inverse(self._T_rig_rect)
        self._limits = config.obstacles.scan
        self._obstacles = Obstacles(geometry, config.obstacles)  # seen at keyframes
        self._T_floor_rig = floor_frame(geometry.rig, self._limits.floor_m)
        self.state = MapState.ODOMETRY_ONLY  # state of the newest pose
        self._warning = ""  # about a saved map of which nothing is recognised
        self.counts = self._localiser.counts  # sizes and counters of the map
        self._copied_scans: object = None  # scans of the map at the last copy of counts and keyframes
        self._keyframes: MapKeyframes | None = None

    def map(self) -> PlaceMap:
        """Return the places whose poses are known relative to the first one: what can be saved."""
        return self._localiser.map()

    def process(self, odometry: OdometryUpdate) -> PlaceUpdate:
        """Return the pose in the map at a pair."""
        places = self._localiser.places
        # 1. The pose in the map.
        pose = self._localiser.process(self._frame(odometry))
        self.state = pose.state
        is_unrecognised = not pose.is_known and self._localiser.failed >= SEARCHES
        self._warning = "no place of the map is recognised: is the robot where it was made?" if is_unrecognised else ""
        # 2. Copies for other threads, which never read the map itself.
        scans = self._localiser.scans()
        if self._keyframes is None or scans is not self._copied_scans:
            ids = sorted(places.keyframes)
            stamps_ns = {id: places.keyframes[id].stamp_ns for id in ids}
            self._keyframes = MapKeyframes(stamps_ns, {id: places.poses[id] for id in ids})
            self._copied_scans, self.counts = scans, self._localiser.counts
        # 3. The message, in the frame of the rig.
        T_map_odom, covariance = carried(pose.T_map_odom, pose.covariance, self._T_rig_rect)
        return PlaceUpdate(
            odometry.seq,
            odometry.stamp_ns,
            T_map_odom,
            T_map_odom @ odometry.T_odom_rig,
            covariance,
            pose.state,
            pose.keyframe,
            self._in_rig(pose.T_keyframe_rect),
            scans,
            self._keyframes,
            pose.is_known,
        )

    def stats(self) -> dict[str, object]:
        """Return the state of the pose in the map, and the sizes and counters of the map."""
        return {"state": self.state, **self.counts, "_warning": self._warning}

    def corrected(self, update: PlaceUpdate) -> Array:
        """Return T_map_rig (4, 4) of an earlier pose by the present map; unchanged if its keyframe was dropped."""
        T_map_rect = self._localiser.places.poses.get(update.keyframe)
        return update.T_map_rig if T_map_rect is None else self._in_rig(T_map_rect) @ update.T_keyframe_rig

    def known(self, updates: Sequence[PlaceUpdate]) -> NDArray[np.bool_]:
        """Return flags (N,) of the earlier poses whose place in the map that can be saved is known now."""
        all_ids, joined = self._localiser.places.keyframes, self.map().keyframes
        return np.array(
            [update.keyframe in joined or (update.keyframe not in all_ids and update.is_known) for update in updates],
            np.bool_,
        )

    def _in_rig(self, T: Array) -> Array:
        """Return a pose (4, 4) of the rectified frame as one of the rig."""
        return np.asarray(self._T_rig_rect @ T @ self._T_rect_rig)

    def _frame(self, odometry: OdometryUpdate) -> OdometryFrame:
        """Return the frame in terms of the rectified frame."""
        depth = odometry.depth
        return OdometryFrame(
            stereo_frame(depth.panoramas, lambda _: self._dense.of(depth).disparity),
            odometry.stamp_ns,
            odometry.T_odom_rect,
            odometry.covariance_rect,
            odometry.state is TrackingState.LOST,
            odometry.reset_counter,
            odometry.is_keyframe,
            lambda: self._ranges(odometry),
        )

    def _ranges(self, odometry: OdometryUpdate) -> tuple[RangeScan, FreeRanges]:
        """Return the range scan of a pair, and up to where floor was seen."""
        scan = self._obstacles.scan(odometry)
        return keyframe_ranges(self._dense.of(odometry.depth), scan, self._T_floor_rig, self._T_rig_rect, self._limits)


def keyframe_ranges(
    depth: DensePoints,
    scan: ObstacleScan,
    T_floor_rig: Array | None,
    T_rig_rect: Array,
    settings: ScanSettings,
) -> tuple[RangeScan, FreeRanges]:
    """Return the ranges of a keyframe and up to where its floor is free, (SECTORS,) by azimuth in the rectified frame.

    The frame is turned level, with its origin on the floor below the lower viewpoint. scan: obstacles at the keyframe.
    T_floor_rig: see floor_frame.
    """
    if T_floor_rig is None:
        return np.full(SECTORS, np.nan, np.float32), np.zeros(SECTORS, np.float32)
    # 1. The level frame below the lower viewpoint, with the heading of the rectified frame.
    T_floor_rect = T_floor_rig @ T_rig_rect
    heading = se3.rotation_exp(np.array([0.0, 0.0, float(se3.yaw(T_floor_rect))]))
    T_level_floor = se3.inverse(se3.transform(heading, np.array([*T_floor_rect[:2, 3], 0.0])))
    # 2. The nearest obstacles by stereo.
    points, view = se3.apply(T_level_floor @ T_floor_rig, depth.points), np.array([0.0, 0.0, T_floor_rect[2, 3]])
    limits = settings.heights_m, math.radians(settings.tilt_deg), settings.min_points
    ranges = point_scan(points, np.sqrt(depth.variance_m2), view, *limits)
    # 3. The free floor by the obstacle scan.
    return ranges, np.minimum(seen_from(scan.free_m, T_level_floor), np.float32(MAX_RANGE_M))
