"""Pose of odom in a saved map by range scans alone: where textures have changed, or views are ambiguous."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from calib import se3
from omnid.core.mapping.range_scan import SECTORS, RangeScan
from omnid.core.mapping.scan_grid import scan_grid
from omnid.core.places.particle_filter import ParticleEstimate, ParticleFilter
from omnid.core.places.place_map import PlaceMap

Array = NDArray[np.float64]

CELL_M: Final = 0.05  # Side of a cell, as in the grids.
UPDATE_M: Final = 0.2  # motion after which a scan is compared; four cells; by trial on development seeds
UPDATE_RAD: Final = math.radians(15)  # The same of the heading; by trial on development seeds.
# M, rad: of height, roll and pitch, because a scan does not measure them.
FLOOR_SIGMA: Final = (0.02, math.radians(0.5))
LEAST_SIGMA: Final = (0.03, math.radians(0.5))  # m, rad: of the others, because cells and scans are no finer


@dataclass(frozen=True, slots=True, eq=False)
class ScanPose:
    """Pose of odom in the map, and the covariance (6, 6) of T_map_rect, [t; r] in the rectified frame."""

    T_map_odom: Array
    covariance: Array


class ScanLocaliser:
    """A particle filter on the grid of the keyframes that a map has now."""

    def __init__(self, places: PlaceMap) -> None:
        ids = sorted(places.keyframes)
        self._scans = [places.keyframes[id].scan.astype(np.float32) for id in ids]
        self._poses = np.array([places.poses[id] for id in ids]).reshape(-1, 4, 4)
        self.ambiguous = 0  # scans that another pose explained as well
        self.restart()

    def restart(self) -> None:
        """Forget where odom is: it was continued after a gap of unknown motion."""
        self._filter: ParticleFilter | None = None
        self._last_T: Array | None = None
        self._found: ScanPose | None = None

    def T_map_rect(self, T_odom_rect: Array) -> Array | None:
        """Return the pose (4, 4) in the map of a frame after the last scan; None while the filter has not converged."""
        return None if self._found is None else np.asarray(self._found.T_map_odom @ T_odom_rect)

    def process(
        self, T_odom_rect: Array, scan: Callable[[], RangeScan], proposed: Sequence[Array] = ()
    ) -> ScanPose | None:
        """Return the pose of odom; None while the filter has not converged. scan is called where it is compared.

        proposed: poses T_map_rect (4, 4), at which the filter begins.
        """
        # 1. Draw the map when it is first asked for.
        if self._filter is None:
            # The robot may be wherever ranges pass, even where the floor was not seen.
            no_floor = [np.zeros(SECTORS, np.float32)] * len(self._scans)
            self._filter = ParticleFilter(scan_grid(self._scans, no_floor, self._poses, CELL_M).open_grid())
        # 2. Move the particles by odometry; a robot at rest shows nothing new.
        if self._last_T is not None:
            moved = se3.inverse(self._last_T) @ T_odom_rect
            if np.linalg.norm(moved[:3, 3]) < UPDATE_M and abs(float(se3.yaw(moved))) < UPDATE_RAD:
                return self._found
            self._filter.move(moved)
        self._last_T = T_odom_rect
        # 3. Weight them by a scan; the pose counts once they have converged.
        estimate = self._filter.update(scan(), proposed)
        self.ambiguous += estimate.ambiguous
        self._found = _pose(estimate, T_odom_rect) if estimate.converged else None
        return self._found


def _pose(estimate: ParticleEstimate, T_odom_rect: Array) -> ScanPose:
    """Return the pose of odom by an estimate, level on the floor of the map."""
    covariance = np.diag(np.repeat(FLOOR_SIGMA, 3)) ** 2
    measured = [0, 1, 5]
    least = np.diag([LEAST_SIGMA[0], LEAST_SIGMA[0], LEAST_SIGMA[1]]) ** 2
    # From the axes of the map to those of the rectified frame.
    R = np.eye(3)
    R[:2, :2] = estimate.T_map_rect[:2, :2]
    covariance[np.ix_(measured, measured)] = R.T @ estimate.covariance @ R + least
    return ScanPose(estimate.T_map_rect @ se3.inverse(T_odom_rect), covariance)
