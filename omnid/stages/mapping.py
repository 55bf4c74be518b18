"""The map of a whole run: points of all frames in one frame, fused in voxels (Dang et al. 2012, section IV.G)."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from calib import se3
from omnid.config import MappingConfig
from omnid.core.mapping.voxel_map import VoxelMap
from omnid.messages import MapUpdate, OdometryUpdate
from omnid.tracking_state import TrackingState

Array = NDArray[np.float64]

LEAST_FRAMES = 2  # that must have seen a voxel, however short the run,
SHORT_RUN = 10  # and one more for so many frames of the run, up to what is asked for


class Path:
    """Where the rig was, in memory that is there from the start; when it is full, every second point is forgotten."""

    def __init__(self, limit: int) -> None:
        self._points = np.full((limit + 1, 2), np.nan)  # written, so that no page of it is new in the hours to come
        self._kept, self._step, self._seen = 0, 1, 0
        self._last: tuple[float, float] | None = None

    def add(self, x_m: float, y_m: float) -> None:
        """Takes the next point."""
        self._last = (x_m, y_m)
        if self._seen % self._step == 0:
            self._points[self._kept] = self._last
            self._kept += 1
        self._seen += 1
        if self._kept == len(self._points):
            thinned = self._points[::2].copy()
            self._kept, self._step = len(thinned), 2 * self._step
            self._points[: self._kept] = thinned

    def xy(self) -> Array:
        """The points (N, 2) kept, and the last one."""
        ends = np.zeros((0, 2)) if self._last is None else np.array([self._last])
        return np.concatenate([self._points[: self._kept], ends])


class Mapping:
    """Fuses the points that are certain enough, at poses that are; the map comes at the end, and every so often."""

    def __init__(self, config: MappingConfig, every_s: float = 0.0) -> None:
        """every_s: by the stamps, between two maps; 0: only at the end."""
        self._config = config
        self._every_ns, self._given_ns = round(every_s * 1e9), 0
        self._map = VoxelMap(config.voxel_m, 1 << config.log2_voxels)
        self._path = Path(config.path_poses)
        self._newest: tuple[int, int] | None = None
        self._frames = 0

    @property
    def counts(self) -> dict[str, int]:
        """Voxels held, voxels given up for want of room, points that were no use."""
        return {"voxels": len(self._map), "evicted": self._map.evicted, "refused": self._map.refused}

    def process(self, odometry: OdometryUpdate) -> MapUpdate | None:
        """Takes the points of a pair, and gives the map when it is due."""
        self._newest = odometry.seq, odometry.stamp_ns
        self._frames += 1
        self._path.add(*map(float, odometry.T_odom_rig[:2, 3]))
        if odometry.state == TrackingState.TRACKING:
            depth = odometry.depth
            sure = depth.variance_m2 < self._config.max_sigma_m**2
            points = se3.apply(odometry.T_odom_rig, depth.points[sure])
            self._map.insert(points, depth.variance_m2[sure], odometry.seq)
        if not self._every_ns or odometry.stamp_ns - self._given_ns < self._every_ns:
            return None
        self._given_ns = odometry.stamp_ns
        return self._update(odometry.seq, odometry.stamp_ns)

    def finish(self) -> list[MapUpdate]:
        """The whole map, if there was a pair at all."""
        return [] if self._newest is None else [self._update(*self._newest)]

    def _update(self, seq: int, stamp_ns: int) -> MapUpdate:
        """What enough frames agree about: false matches are seldom made twice in the same place."""
        enough = min(self._config.min_frames, max(LEAST_FRAMES, self._frames // SHORT_RUN))
        return MapUpdate(seq, stamp_ns, self._map.points(enough), self._path.xy())
