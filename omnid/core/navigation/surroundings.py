"""Surroundings of the base, in odom: the grid of the obstacles, and the predicted places of moving objects.

A moving object keeps its velocity (van den Berg, Lin, Manocha 2008, "Reciprocal velocity obstacles", ICRA: the usual
assumption over some seconds). It is no part of the grid here, but an obstacle where the base would meet it. Unknown
floor has a cost, as it may be seen when the base comes near. Floor that was not seen from near, such as behind a plain
surface, is an obstacle until it is seen, because coming nearer shows no more. So is the end of a way along which small
probabilities of obstacles add up to more than the risk, though each of its cells is free: the collision monitor stops
the base there.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Final

import cv2
import numpy as np
from numpy.typing import NDArray

from calib.se2_arrays import from_segments_m
from omnid.core.control.collision_monitor import CollisionSettings, unknown_ends
from omnid.core.navigation.path import ways_m
from omnid.core.obstacles.grid import CELL_M, OCCUPIED, SQUARE, UNKNOWN, FloorGrid
from omnid.core.obstacles.moving_tracker import MovingObstacle

Array = NDArray[np.float64]
Ranges = NDArray[np.floating]
Flags = NDArray[np.bool_]

FAR_M: Final = 1e3  # distance where there is no obstacle
NEAR_M: Final = 1.2  # Floor nearer than that would be seen if it could be.
HORIZON_S: Final = 4.0  # The prediction of a moving object ends after this time.
MEETING_S: Final = 0.6  # The base or a moving object may be early or late by this time.
LARGEST_SIGMA_M: Final = 0.15  # Most uncertainty of a prediction that is kept free: beyond it nothing would be free.
OWN_M: Final = 0.25  # Cells belong to a moving object up to this distance beyond its radius.
TRAIL_S: Final = 0.5  # The grid shows a moving object for this time where it was, because pairs vote.
ROUNDING_M: Final = 0.1 * CELL_M  # A smaller change of the distance between two points of a way is none.


class Surroundings:
    """The grid of a pair with the distances in it, and moving objects; positions in odom."""

    def __init__(
        self,
        grid: FloorGrid,
        moving: Sequence[MovingObstacle] = (),
        stamp_ns: int = 0,
        pose: Array | None = None,
        before: Surroundings | None = None,
        ends: Array | None = None,
    ) -> None:
        """stamp_ns, pose (3,): of the pair. before: surroundings of an earlier pair, in the same odom.

        ends (N, 2): where near ways end, by `near_ends`.
        """
        self.grid, self.stamp_ns, states = grid, stamp_ns, grid.states
        self._state = np.array([(m.x_m, m.y_m, m.vx_mps, m.vy_mps) for m in moving]).reshape(-1, 4)
        self._radius_m = np.array([m.radius_m for m in moving])
        self._covariance = np.array([m.covariance for m in moving]).reshape(-1, 4, 4)
        # 1. Obstacles at rest, without moving objects and their trails.
        is_occupied = states == OCCUPIED
        trail = self._state[:, :2] - TRAIL_S * self._state[:, 2:]
        is_own = from_segments_m(self._places(is_occupied), trail, self._state[:, :2]) <= self._radius_m + OWN_M
        is_occupied[is_occupied] = ~is_own.any(axis=1)
        self.distance_m = distances_m(is_occupied)  # of each cell to the nearest obstacle
        # 2. Floor that is not known, and patches of floor that were not seen although the base came near.
        self.is_unknown = states == UNKNOWN
        is_patch = cv2.morphologyEx(self.is_unknown.view(np.uint8), cv2.MORPH_OPEN, SQUARE) > 0
        is_unseen = np.zeros(states.shape, bool)
        if pose is not None:
            middle = grid.corner_m + 0.5 * CELL_M - pose[:2]
            y, x = CELL_M * np.indices(states.shape) + middle[::-1, None, None]
            is_unseen = np.hypot(x, y) < NEAR_M
        if before is not None:
            is_unseen |= self._cells(before._unseen)
        is_unseen &= is_patch
        self._unseen: Array = self._places(is_unseen)
        # 3. Where ways end among cells each of which is free.
        if ends is not None:
            is_end = self._cells(ends)
            self.is_unknown, is_unseen = self.is_unknown | is_end, is_unseen | is_end
        # Of each cell to an obstacle, or to floor that was not seen from near.
        self.closed_distance_m = distances_m(is_occupied | is_unseen)

    @property
    def has_moving(self) -> bool:
        """True if there is a moving object."""
        return len(self._state) > 0

    def _places(self, flags: Flags) -> Array:
        """Return the middles (N, 2) of the cells that are set, row by row."""
        return np.asarray(self.grid.corner_m + CELL_M * (np.argwhere(flags)[:, ::-1] + 0.5))

    def _cells(self, points: Array) -> Flags:
        """Return the cells in which points (N, 2) are."""
        flags = np.zeros(self.grid.occupied.shape, bool)
        rows, columns = self.grid.at(points)
        inside = (np.minimum(rows, columns) >= 0) & (np.maximum(rows, columns) < len(flags))
        flags[rows[inside], columns[inside]] = True
        return flags

    def distance_at(self, points: Array, distances: Array | None = None) -> Array:
        """Return the distance of points (N, 2) to the nearest obstacle, FAR_M outside the grid.

        distances: of the cells; None: distance_m.
        """
        distances = self.distance_m if distances is None else distances
        rows, columns = self.grid.at(points)
        size = len(distances)
        inside = (np.minimum(rows, columns) >= 0) & (np.maximum(rows, columns) < size)
        return np.asarray(np.where(inside, distances[rows.clip(0, size - 1), columns.clip(0, size - 1)], FAR_M))

    def movers(self, now_ns: int) -> Array:
        """Return position, velocity and radius (K, 5) of moving objects, as predicted for now, with one sigma."""
        age_s = (now_ns - self.stamp_ns) * 1e-9
        t = age_s + 0.5 * HORIZON_S
        P = np.moveaxis(self._covariance, 0, 2)
        variance = np.maximum(*(P[k, k] + 2 * t * P[k, k + 2] + t**2 * P[k + 2, k + 2] for k in (0, 1)))
        radius_m = self._radius_m + np.minimum(np.sqrt(np.maximum(variance, 0.0)), LARGEST_SIGMA_M)
        xy, velocity = self._state[:, :2], self._state[:, 2:]
        return np.column_stack([xy + age_s * velocity, velocity, radius_m])

    def path_distance_m(self, path: Array, now_ns: int, speed_mps: float, distances: Array | None = None) -> Array:
        """Return the distance (N,) of points of a path (N, 2) from obstacles; distances: as in `distance_at`.

        A moving object counts where it is when the base, at a speed, reaches the point.
        """
        at_rest_m = self.distance_at(path, distances)
        if not self.has_moving:
            return at_rest_m
        movers, times_s = self.movers(now_ns), ways_m(path) / speed_mps
        early, late = (
            movers[:, :2] + np.clip(times_s + shift_s, 0.0, HORIZON_S)[:, None, None] * movers[:, 2:4]
            for shift_s in (-MEETING_S, MEETING_S)
        )
        return np.asarray(np.minimum(at_rest_m, (from_segments_m(path, early, late) - movers[:, 4]).min(axis=1)))

    def first_blocked_m(self, path: Array, required_m: float, now_ns: int, speed_mps: float) -> float:
        """Return the way along a path (N, 2) to where an obstacle is nearer than required_m; inf without one.

        An obstacle that the base is near to already, and drives away from, does not count.
        """
        distance_m = self.path_distance_m(path, now_ns, speed_mps)
        is_blocked = distance_m < required_m
        if is_blocked[0]:
            leaves = np.minimum.accumulate(np.append(True, np.diff(distance_m) > -ROUNDING_M))
            is_blocked &= ~(leaves & np.minimum.accumulate(is_blocked))
        return float(ways_m(path)[np.argmax(is_blocked)]) if is_blocked.any() else math.inf


def near_ends(pose: Array, ranges_m: Ranges, free_m: Ranges, collision: CollisionSettings) -> Array:
    """Return the places (N, 2) near a pose (3,) where floor in view ends for the collision monitor, without a surface.

    ranges_m, free_m (S,): of a scan from there. collision: the outline, in which nothing ends, and the distance within
    which an end belongs to a surface, in any direction: along a wall, no ray shows floor up to it.
    """
    outline = collision.outline
    ends = unknown_ends(ranges_m.tolist(), free_m.tolist(), collision.stop_m)
    azimuths = (np.arange(len(ranges_m)) + 0.5) * (math.tau / len(ranges_m)) - math.pi
    directions = np.column_stack([np.cos(azimuths + pose[2]), np.sin(azimuths + pose[2])])
    sectors = np.array([end.sector for end in ends], np.intp)
    edges_m = [outline.edge_m(math.cos(azimuth), math.sin(azimuth)) for azimuth in azimuths[sectors]]
    away_m = np.maximum([end.free_m for end in ends], edges_m)
    is_seen, places = np.isfinite(ranges_m), away_m[:, None] * directions[sectors]
    surfaces = ranges_m[is_seen, None] * directions[is_seen]
    from_surface_m = np.linalg.norm(places[:, None] - surfaces, axis=2).min(axis=1, initial=math.inf)
    return np.asarray(pose[:2] + places[(away_m < NEAR_M) & (from_surface_m > collision.stop_m)])


def distances_m(flags: Flags) -> Array:
    """Return the distance of each cell to the nearest one that is set [m]."""
    if not flags.any():
        return np.full(flags.shape, FAR_M)
    return np.asarray(cv2.distanceTransform((~flags).view(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_PRECISE) * CELL_M, "f8")
