"""Map of a run: points of all pairs in one frame, fused in voxels (Dang et al. 2012, section IV.G), and its grid."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from calib import se3
from omnid.config import MappingConfig
from omnid.core.mapping.scan_grid import KeyframeGrid
from omnid.core.mapping.voxel_map import ThinnedPath, VoxelMap
from omnid.core.nanoseconds import NS_PER_S, STAMP_JITTER_NS
from omnid.messages import GridUpdate, MapUpdate, OdometryUpdate, PlaceUpdate
from omnid.stages.geometry import DenseDepths
from omnid.tracking_state import TrackingState

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

    @property
    def counts(self) -> dict[str, int]:
        """Voxels of the map."""
        return {"voxels": len(self._map)}

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

    def finish(self) -> list[GridUpdate]:
        """Return the final grid, if there was a keyframe."""
        final = None if self._newest is None else self._update(self._newest)
        return [] if final is None else [final]

    def _update(self, newest: PlaceUpdate) -> GridUpdate | None:
        if newest.scans is None or not newest.scans.scans or newest.scans is self._drawn:
            return None
        self._drawn_ns, self._drawn = newest.stamp_ns, newest.scans
        return GridUpdate(newest.seq, newest.stamp_ns, self._grid.draw(newest.scans, self._T_base_rect))
