"""Places stage: keeps keyframes of odometry, recognises places, and gives the pose of odom in the map."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from calib import se3
from omnid.config import Config
from omnid.core.mapping.range_scan import MAX_RANGE_M, SECTORS, FreeRanges, RangeScan, point_scan, seen_from
from omnid.core.obstacles.settings import ScanSettings
from omnid.core.odometry.stereo_frame import StereoFrame
from omnid.core.places.localisation import MapLocaliser, OdometryFrame
from omnid.core.places.place_map import PlaceMap
from omnid.messages import DensePoints, MapKeyframes, ObstacleScan, OdometryUpdate, PlaceUpdate
from omnid.stages.geometry import DenseDepths, Geometry
from omnid.stages.obstacles import CameraFloor, Obstacles
from omnid.tracking_state import MapState, TrackingState

Array = NDArray[np.float64]


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
        self._obstacles = Obstacles(geometry, config.obstacles, dense)  # at keyframes
        self.floor = self._obstacles.floor
        self.state = MapState.ODOMETRY_ONLY  # state of the newest pose
        self.counts = self._localiser.counts  # sizes and counters of the map
        self._shown: object = None  # scans of the map when these were counted and its keyframes were copied
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
        # 2. What other threads need of the map, which they never read itself.
        scans = self._localiser.scans()
        if self._keyframes is None or scans is not self._shown:
            ids = sorted(places.keyframes)
            stamps_ns = {id: places.keyframes[id].stamp_ns for id in ids}
            self._keyframes = MapKeyframes(stamps_ns, {id: places.poses[id] for id in ids})
            self._shown, self.counts = scans, self._localiser.counts
        # 3. The message, in the frame of the rig.
        T_map_odom, to_rig = self._in_rig(pose.T_map_odom), se3.adjoint(self._T_rig_rect)
        return PlaceUpdate(
            odometry.seq,
            odometry.stamp_ns,
            T_map_odom,
            T_map_odom @ odometry.T_odom_rig,
            to_rig @ pose.covariance @ to_rig.T,
            pose.state,
            pose.keyframe,
            self._in_rig(pose.T_keyframe_rect),
            scans,
            self._keyframes,
            pose.is_known,
        )

    def stats(self) -> dict[str, object]:
        """Return the state of the pose in the map, and the sizes and counters of the map."""
        return {"state": self.state, **self.counts}

    def corrected(self, update: PlaceUpdate) -> Array:
        """Return T_map_rig (4, 4) of an earlier pose by the map of now; unchanged if its keyframe was dropped."""
        T_map_rect = self._localiser.places.poses.get(update.keyframe)
        return update.T_map_rig if T_map_rect is None else self._in_rig(T_map_rect) @ update.T_keyframe_rig

    def known(self, updates: Sequence[PlaceUpdate]) -> NDArray[np.bool_]:
        """Return at which of earlier poses (N,) it is known now where odom lay in the map that can be saved."""
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
        depth, pair = odometry.depth, odometry.depth.panoramas
        usable = np.zeros_like(pair.visible) if pair.light.shows_nothing else pair.usable
        stereo = StereoFrame(
            odometry.seq, pair.lower, pair.upper, lambda _: self._dense.of(depth).disparity, usable, pair.times
        )
        return OdometryFrame(
            stereo,
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
        dense = self._dense.of(odometry.depth)
        self.floor.add(dense)
        scan = self._obstacles.scan(odometry)
        return keyframe_ranges(dense, scan, self.floor, self._T_rig_rect, self._limits)


def keyframe_ranges(
    depth: DensePoints,
    scan: ObstacleScan,
    camera_floor: CameraFloor,
    T_rig_rect: Array,
    settings: ScanSettings,
) -> tuple[RangeScan, FreeRanges]:
    """Return the ranges of a keyframe and up to where its floor is free, (SECTORS,) by azimuth in the rectified frame.

    They are turned level, and those of the floor below the lower viewpoint. scan: of obstacles at the keyframe.
    """
    floor = camera_floor.floor
    if floor is None:
        return np.full(SECTORS, np.nan, np.float32), np.zeros(SECTORS, np.float32)
    # 1. The level frame below the lower viewpoint, with the heading of the rectified frame.
    T_floor_rig = camera_floor.T_floor_rig(floor)
    T_floor_rect = T_floor_rig @ T_rig_rect
    heading = se3.rotation_exp(np.array([0.0, 0.0, float(se3.yaw(T_floor_rect))]))
    T_level_floor = se3.inverse(se3.transform(heading, np.array([*T_floor_rect[:2, 3], 0.0])))
    # 2. The nearest obstacles by stereo.
    points, view = se3.apply(T_level_floor @ T_floor_rig, depth.points), np.array([0.0, 0.0, T_floor_rect[2, 3]])
    limits = settings.heights_m, math.radians(settings.tilt_deg), settings.min_points
    ranges = point_scan(points, np.sqrt(depth.variance_m2), view, *limits, floor.sigma_m)
    # 3. The free floor by the obstacle scan.
    return ranges, np.minimum(seen_from(scan.free_m, T_level_floor), np.float32(MAX_RANGE_M))
