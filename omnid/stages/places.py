"""Places stage: keeps keyframes of odometry, recognises places, and gives the pose of odom in the map."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Sequence
from typing import Final

import numpy as np
from numpy.typing import NDArray

from calib import se3
from omnid.config import Config
from omnid.core.mapping.range_scan import (
    MAX_RANGE_M,
    SECTORS,
    FreeRanges,
    RangeScan,
    ScanLimits,
    point_scan,
    seen_from,
)
from omnid.core.nanoseconds import NS_PER_S
from omnid.core.navigation.requests import NavigationCommand, TaughtRoute
from omnid.core.obstacles.settings import ScanSettings
from omnid.core.odometry.stereo_frame import StereoFrame
from omnid.core.places.localisation import MapLocaliser, OdometryFrame
from omnid.core.places.place_map import PlaceMap
from omnid.messages import (
    DensePoints,
    MapCopy,
    MapKeyframes,
    ObstacleScan,
    OdometryUpdate,
    PlaceUpdate,
    SaveMap,
    StereoDepth,
)
from omnid.stages.dense_depths import DenseDepths
from omnid.stages.geometry import Geometry
from omnid.stages.obstacles import CameraFloor, PairScans
from omnid.tracking_state import MapState, TrackingState
from omnid.transport.topics import MOST_OPEN

Array = NDArray[np.float64]


# Time between two counts, which take 1 ms for 1,000 keyframes; the status comes no oftener.
COUNTED_NS: Final = NS_PER_S


class Places:
    """Localise the poses of odometry in a map of places, which grows with them.

    The map belongs to the thread of this stage until the run ends. It leaves it by the copies that updates carry.
    """

    def __init__(
        self,
        geometry: Geometry,
        config: Config,
        dense: DenseDepths,
        places: PlaceMap | None = None,
        *,
        localize_only: bool = False,
        copy_s: float = 0.0,
    ) -> None:
        """dense: computes the depth of keyframes. places: a map to be extended, None: a new one. localize_only: the map
        stays as it is. copy_s: time between two copies of the map that are to be written, by the stamps; 0: none.
        """
        self._dense = dense
        self._localiser = MapLocaliser(
            geometry.model(config.odometry.noise_px), config.places.limits, places, localize_only=localize_only
        )
        self._T_rig_rect = geometry.T_rig_rect
        self._limits = config.obstacles.scan
        self._scans = PairScans(geometry, config.obstacles.scan)  # at keyframes
        self.floor = CameraFloor(geometry.rig, config.obstacles.scan.floor_m)
        self._T_rect_rig = se3.inverse(self._T_rig_rect)
        self._to_rig = se3.adjoint(self._T_rig_rect)
        self.state = MapState.ODOMETRY_ONLY  # state of the newest pose
        self.counts = self._localiser.counts  # sizes and counters of the map; each second, and at the end
        self._counted_ns = 0
        self._keyframes: tuple[object, MapKeyframes] | None = None  # what they depend on, and they
        self._copy_ns, self._copied_ns = round(copy_s * NS_PER_S), 0
        self._copy_wanted = False
        self._copy: MapCopy | None = None
        self._asked: deque[int] = deque(maxlen=MOST_OPEN)  # ids of requests for a copy: a sink may miss updates

    def map(self) -> PlaceMap:
        """Return the places whose poses are known relative to the first one: what can be saved."""
        return self._localiser.map()

    def process(self, message: OdometryUpdate | SaveMap | NavigationCommand) -> PlaceUpdate | None:
        """Return the pose in the map at a pair.

        Requests to write the map, and routes that were written, for which the map must be, have it copied then.
        """
        match message:
            case SaveMap():
                self._copy_wanted = True
                self._asked.append(message.id)
                return None
            case NavigationCommand():
                self._copy_wanted |= isinstance(message.request, TaughtRoute) and not message.refusal
                return None
        return self._localised(message)

    def _localised(self, odometry: OdometryUpdate) -> PlaceUpdate:
        # 1. The pose in the map.
        pose = self._localiser.process(self._frame(odometry))
        self.state = pose.state
        # 2. Copies for other threads, which never read the map itself.
        self._copied_ns = self._copied_ns or odometry.stamp_ns
        if self._copy_wanted or (self._copy_ns and odometry.stamp_ns - self._copied_ns >= self._copy_ns):
            self._copy_wanted, self._copied_ns = False, odometry.stamp_ns
            places = self._localiser.places
            self._copy = MapCopy(places.part(places.keyframes), tuple(self._asked))
        if odometry.stamp_ns >= self._counted_ns + COUNTED_NS:
            self._counted_ns, self.counts = odometry.stamp_ns, self._localiser.counts
        # 3. The message, in the frame of the rig.
        T_map_odom = self._T_rig_rect @ pose.T_map_odom @ self._T_rect_rig
        T_map_rig = T_map_odom @ odometry.T_odom_rig
        covariance = self._to_rig @ pose.covariance @ self._to_rig.T
        T_keyframe_rig = self._T_rig_rect @ pose.T_keyframe_rect @ self._T_rect_rig
        scans = self._localiser.scans()
        return PlaceUpdate(
            odometry.seq,
            odometry.stamp_ns,
            T_map_odom,
            T_map_rig,
            covariance,
            pose.state,
            pose.keyframe,
            T_keyframe_rig,
            scans,
            self._copied_keyframes(scans),
            pose.is_known,
            self._copy,
        )

    def stats(self) -> dict[str, object]:
        """Return the state of the pose in the map, and the sizes and counters of the map."""
        return {"state": self.state, **self.counts}

    def finish(self) -> list[PlaceUpdate]:
        """Count at the end."""
        self.counts = self._localiser.counts
        return []

    def corrected(self, update: PlaceUpdate) -> Array:
        """Return T_map_rig (4, 4) of an earlier pose by the map of now; unchanged if its keyframe was dropped."""
        T_map_rect = self._localiser.places.poses.get(update.keyframe)
        if T_map_rect is None:
            return update.T_map_rig
        return np.asarray(self._T_rig_rect @ T_map_rect @ self._T_rect_rig @ update.T_keyframe_rig)

    def known(self, updates: Sequence[PlaceUpdate]) -> NDArray[np.bool_]:
        """Return at which of earlier poses (N,) it is known now where odom lay in the map that can be saved."""
        all_ids, joined = self._localiser.places.keyframes, self.map().keyframes
        return np.array(
            [update.keyframe in joined or (update.keyframe not in all_ids and update.is_known) for update in updates],
            np.bool_,
        )

    def _copied_keyframes(self, scans: object) -> MapKeyframes:
        """Return the keyframes of the map; scans: the same object while the map stays."""
        if self._keyframes is None or self._keyframes[0] is not scans:
            places = self._localiser.places
            ids = sorted(places.keyframes)
            self._keyframes = (
                scans,
                MapKeyframes({id: places.keyframes[id].stamp_ns for id in ids}, {id: places.poses[id] for id in ids}),
            )
        return self._keyframes[1]

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
            lambda: self._scan(depth),
            lambda: self._free(odometry),
        )

    def _free(self, odometry: OdometryUpdate) -> FreeRanges:
        """Return the free ranges of a pair."""
        scan = self._scans.add(odometry, self.floor)
        return keyframe_free(scan, self._scans.thin_m, self.floor, self._T_rig_rect)

    def _scan(self, depth: StereoDepth) -> RangeScan:
        """Return the range scan of a pair."""
        dense = self._dense.of(depth)
        self.floor.add(dense)
        return keyframe_scan(dense, self.floor, self._T_rig_rect, self._limits)


def keyframe_scan(
    depth: DensePoints, camera_floor: CameraFloor, T_rig_rect: Array, settings: ScanSettings
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


def keyframe_free(scan: ObstacleScan, thin_m: FreeRanges, camera_floor: CameraFloor, T_rig_rect: Array) -> FreeRanges:
    """Return the range up to which the obstacle scan at a keyframe is free, (SECTORS,) as its range scan.

    thin_m (SECTORS,): where something thin may begin to hide the floor, inf: nowhere; there they are negative.
    """
    floor = camera_floor.floor
    if floor is None:
        return np.zeros(SECTORS, np.float32)
    free_m = seen_from(scan.free_m, _T_level_floor(camera_floor.T_floor_rig(floor) @ T_rig_rect))
    free_m = np.minimum(free_m, np.float32(MAX_RANGE_M))
    return np.where(np.isfinite(thin_m), -np.minimum(free_m, thin_m), free_m)


def _T_level_floor(T_floor_rect: Array) -> Array:
    """Return the transform to the level frame below the lower viewpoint, with the heading of the rectified frame."""
    heading = se3.rotation_exp(np.array([0.0, 0.0, float(se3.yaw(T_floor_rect))]))
    return se3.inverse(se3.transform(heading, np.array([*T_floor_rect[:2, 3], 0.0])))
