"""Rings by the obstacle grid, to which pairs are added as they come: those of a run, or its keyframes."""

from __future__ import annotations

from typing import Final

import numpy as np
from numpy.typing import NDArray

from calib import se3
from calib.se2_arrays import planar, transform
from omnid.core.floor import Floor
from omnid.core.frames import of_base
from omnid.core.mapping.range_scan import SECTORS, FreeRanges
from omnid.core.obstacles.column import NEAREST_M, ColumnEvidence, Columns, floor_plane
from omnid.core.obstacles.fixed_parts import FixedParts
from omnid.core.obstacles.grid import ObstacleGrid
from omnid.core.obstacles.moving_tracker import MovingTracker
from omnid.core.obstacles.narrow import narrow_m, nothing_narrow
from omnid.core.obstacles.pair_views import FOCAL_PX
from omnid.core.obstacles.settings import RingSettings
from omnid.core.obstacles.unwatched import Unwatched, without
from omnid.messages import ObstacleRing, OdometryUpdate, Panoramas
from omnid.stages.floor import CameraFloor
from omnid.stages.geometry import Geometry
from omnid.tracking_state import TrackingState

Array = NDArray[np.float64]

# Ring of a pair while the floor is not known.
UNKNOWN: Final = np.full(SECTORS, np.nan, np.float32)
NOT_FREE: Final = np.zeros(SECTORS, np.float32)


class PairRings:
    """The obstacle grid of a run, the obstacles that move in it, and its ring at each pair that is added."""

    def __init__(self, geometry: Geometry, settings: RingSettings) -> None:
        self._geometry, self._settings = geometry, settings
        self._of_floor: Floor | None = None  # floor for which the columns were made
        self.fixed = FixedParts(geometry.cylinder)
        self._left_out = self.fixed.pixels  # those of the columns
        self._is_misled = False  # whether the grid holds what fixed parts have shown
        self._columns: Columns | None = None
        self._evidence: ColumnEvidence | None = None  # of the newest pair
        self._grid = ObstacleGrid(FOCAL_PX * geometry.rig.baseline_m, settings)
        self._tracker = MovingTracker()
        self._unwatched = Unwatched(geometry.cylinder, geometry.rig.T_base_rig @ geometry.T_rig_rect)
        self._resets = 0

    def add(self, odometry: OdometryUpdate, camera_floor: CameraFloor) -> ObstacleRing:
        """Add the evidence of a pair; return the ring at it, which is unknown while the floor or the pose is."""
        # 1. Forget the grid and the tracks where odometry has begun again.
        if odometry.reset_counter != self._resets:
            self._grid.begin_again()
            self._tracker.clear()
            self._resets, self._is_misled = odometry.reset_counter, False
        panoramas, self._evidence = odometry.depth.panoramas, None
        T_odom_base = of_base(odometry, self._geometry.rig.T_base_rig)[0]
        unwatched = self._unwatched.sectors(panoramas.tiles.unknown)
        unknown = ObstacleRing(odometry.seq, odometry.stamp_ns, UNKNOWN, UNKNOWN, NOT_FREE, T_odom_base, (), unwatched)
        if odometry.state is TrackingState.LOST:
            # The grid stays: it holds again once odometry recognises its landmarks.
            self._tracker.clear()
            return unknown
        self._leave_out_fixed_parts(panoramas, T_odom_base)
        columns = self._columns_of(camera_floor, panoramas)
        if columns is None:
            return unknown
        # 2. The evidence of the images, without their dead and blind parts.
        lost = panoramas.tiles.lost_pixels(panoramas.visible.shape)
        evidence = self._evidence = columns.evidence(panoramas.lower, panoramas.upper, lost)
        # 3. The grid, its ring, and the moving obstacles.
        pose = transform(planar(T_odom_base))
        unseen = self._unwatched.directions(panoramas.tiles.unknown)
        ring = without(self._grid.update(odometry.stamp_ns, pose, evidence), unwatched, unseen)
        moving = self._tracker.update(odometry.stamp_ns, self._grid.viewpoint(pose), ring.arrivals)
        return ObstacleRing(
            odometry.seq, odometry.stamp_ns, ring.ranges_m, ring.sigma_m, ring.free_m, T_odom_base, moving, unwatched
        )

    @property
    def narrow_m(self) -> FreeRanges:
        """Least range (SECTORS,) [m] at which something narrow hides floor by the newest pair, inf: nothing does.

        Sectors are those of the rectified frame.
        """
        if self._evidence is None or self._columns is None:
            return nothing_narrow()
        return narrow_m(self._evidence.floor, self._columns.at_1m)

    def _leave_out_fixed_parts(self, panoramas: Panoramas, T_odom_base: Array) -> None:
        """Learn what is fixed to a camera, and leave it out; frozen parts are the same at all headings, too."""
        if panoramas.tiles.is_frozen:
            return
        if not self.fixed.observe(T_odom_base, panoramas.lower, panoramas.upper, panoramas.visible):
            return
        if self.fixed.pixels is not self._left_out:
            self._left_out, self._of_floor, self._is_misled = self.fixed.pixels, None, True
        if self._is_misled and self.fixed.is_on_the_spot:
            # The floor too near to be seen is taken to be free again: a base that came here might know better.
            self._grid.begin_again()
            self._tracker.clear()
            self._is_misled = False

    def _columns_of(self, camera_floor: CameraFloor, panoramas: Panoramas) -> Columns | None:
        """Return the columns for the floor and what is left out, None without a floor."""
        floor = camera_floor.floor
        if floor is not None and floor is not self._of_floor:
            geometry, settings = self._geometry, self._settings
            T_rect_floor = geometry.rig.T_rect_rig @ se3.inverse(camera_floor.T_floor_rig(floor))
            plane = floor_plane(T_rect_floor)
            self._of_floor = floor
            self._columns = Columns(
                geometry.cylinder,
                geometry.rig.baseline_m,
                plane,
                settings.heights_m,
                (NEAREST_M, settings.max_range_m),
                panoramas.visible & ~self._left_out,
            )
            self._grid.set_floor(T_rect_floor, plane.height_m)
        return self._columns
