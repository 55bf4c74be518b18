"""The way around obstacles: dynamic window on the distances of a wave front, within a corridor of the path.

Fox, Burgard, Thrun, "The dynamic window approach to collision avoidance", IEEE RAM 1997; Brock, Khatib, "High-speed
navigation using the global dynamic window approach", ICRA 1999: arcs that keep clear of all obstacles are judged by the
distance that is left at their end, by a wave front (NF1) from a free point of the path behind the obstacle. So there
are no local minima within the grid. What moves is judged at its predicted places: the base lets it pass by driving more
slowly along the path, and arcs keep clear of it at each moment (`forecast.py`).
"""

from __future__ import annotations

import math
from typing import Final, NamedTuple

import cv2
import numpy as np
import scipy
from numpy.typing import NDArray

from omnid.core.control.collision_monitor import CollisionSettings
from omnid.core.control.heading_controller import Setpoint
from omnid.core.navigation.forecast import Forecast, Pace, yielding
from omnid.core.navigation.settings import NavigationSettings
from omnid.core.navigation.situation import NOWHERE

Array = NDArray[np.float64]


# Set by trial on development seeds, where a line gives no other reason.
# By trial on development seeds.
CELL_M: Final = 0.05
HALF_CELLS: Final = 64  # Half the side of the grid about the base: 3.2 m to each side.
# Way left where no way leads to the path; so that it is never chosen: longer than any way in the grid.
FAR_M: Final = 1e3


def to_cells(points: Array, corner: Array) -> NDArray[np.intp]:
    """Return columns and rows (..., 2) of points (..., 2), those beyond the grid at its border."""
    return np.clip(((points - corner) / CELL_M).round(), 0, 2 * HALF_CELLS).astype(np.intp)


def grid_distances(points: Array, corner: Array) -> Array:
    """Return the distance of each cell to the nearest point [m]."""
    size = 2 * HALF_CELLS + 1
    inside = ((points >= corner) & (points <= corner + 2 * HALF_CELLS * CELL_M)).all(axis=1)
    grid = np.ones((size, size), np.uint8)
    cells = to_cells(points[inside], corner)
    grid[cells[:, 1], cells[:, 0]] = 0
    if not len(cells):
        return np.full((size, size), FAR_M)
    return np.asarray(cv2.distanceTransform(grid, cv2.DIST_L2, cv2.DIST_MASK_PRECISE) * CELL_M, np.float64)


class Neighbours(NamedTuple):
    """Edges between neighbouring cells of the grid, in the order of their first cell."""

    first: NDArray[np.int32]
    second: NDArray[np.int32]
    length_m: Array


def neighbours() -> Neighbours:
    """Return the edges to the eight cells around each cell."""
    size = 2 * HALF_CELLS + 1
    rows, columns, steps = np.meshgrid(np.arange(size), np.arange(size), np.arange(8), indexing="ij")
    dy = np.array([-1, -1, -1, 0, 0, 1, 1, 1])[steps]
    dx = np.array([-1, 0, 1, -1, 1, -1, 0, 1])[steps]
    inside = (rows + dy >= 0) & (rows + dy < size) & (columns + dx >= 0) & (columns + dx < size)
    first = (rows * size + columns)[inside]
    second = ((rows + dy) * size + columns + dx)[inside]
    return Neighbours(first.astype(np.int32), second.astype(np.int32), CELL_M * np.hypot(dx, dy)[inside])


def wave_front(edges: Neighbours, is_free: NDArray[np.bool_], weight: Array, goal: NDArray[np.intp]) -> Array | None:
    """Return the weighted way from each free cell to the goal [m], FAR_M without one; None if the goal is not free."""
    column, row = int(goal[0]), int(goal[1])
    if not is_free[row, column]:
        return None
    free = is_free.ravel()
    usable = free[edges.first] & free[edges.second]
    counts = np.bincount(edges.first[usable], minlength=free.size)
    lengths = edges.length_m[usable] * weight.ravel()[edges.first[usable]]
    graph = scipy.sparse.csr_matrix(
        (lengths, edges.second[usable], np.concatenate([[0], np.cumsum(counts)])), shape=(free.size, free.size)
    )
    found = scipy.sparse.csgraph.dijkstra(graph, indices=row * len(is_free) + column)
    return np.asarray(np.where(np.isfinite(found), found, FAR_M).reshape(is_free.shape))


def descent(left_m: Array, rows: NDArray[np.intp], columns: NDArray[np.intp]) -> Array:
    """Return the direction [rad] in which the way left falls most, over some cells."""
    best, direction = np.full(len(rows), np.inf), np.zeros(len(rows))
    reach, limit = 4, len(left_m) - 1
    for k in range(16):
        angle = 2 * math.pi * k / 16
        r = np.clip(rows + round(reach * math.sin(angle)), 0, limit)
        c = np.clip(columns + round(reach * math.cos(angle)), 0, limit)
        lower = left_m[r, c] < best
        best, direction = np.where(lower, left_m[r, c], best), np.where(lower, angle, direction)
    return direction


# Set by trial on development seeds, where a line gives no other reason.
AHEAD_M: Final = 2.0  # Length of the path in which obstacles are searched.
REJOIN_M: Final = 0.3  # Length of free path behind the obstacle at which a detour ends.
REJOIN_WITHIN_M: Final = 3.0  # Most length of the way to the end of a detour: within the grid.
BACK_ON_PATH_M: Final = 0.12  # Lateral distance from the path below which it is followed again.
BEFORE_M: Final = 0.35  # Distance of the outline from an obstacle on the path at which the base waits.
WAIT_MPS2: Final = 0.2  # Deceleration towards an obstacle at which the base waits.
ARC_S: Final = 1.6  # length of an arc
ARC_STEPS: Final = 8
SPEEDS: Final = 4
YAW_RATES: Final = 17
SHARE: Final = 0.7  # Share of the speed that is driven on a detour.
HEADING_M_PER_RAD: Final = 0.25  # Cost of a radian of heading error, as metres of way.
BACK_MPS: Final = -0.12  # Speed out of a place that has become too narrow.
BACK_WEIGHT_M: Final = 0.5
NARROW: Final = 2.0  # Weight of narrow places in the cost of a way.
NEAR_M: Final = 1.5  # Obstacles within this distance are tested against arcs.
NEARER_M: Final = 0.005
CLEARANCE_WEIGHT_M: Final = 0.4
MARGIN_M: Final = 0.02  # Room in addition to that which the collision monitor demands.
# Cosine of the direction beyond which an obstacle is behind; 100 degrees; by trial on development seeds.
BEHIND_SHARE: Final = -0.17

STANDS: Final = "something stands on the path"
CROSSES: Final = "somebody or something crosses the path"


class Detour(NamedTuple):
    """Answer of the planner."""

    setpoint: Setpoint | None  # None: the base waits, because no way is free
    avoiding: bool  # True while the base is off the path, around an obstacle
    reason: str = ""  # why the base does not follow the path at the wanted speed


class LocalPlanner:
    """Decide at each pose whether the path can be followed, and go around obstacles on it. All in odom."""

    def __init__(self, settings: NavigationSettings, collision: CollisionSettings) -> None:
        """collision: the outline of the base, and the room that the collision monitor demands."""
        self._settings = settings
        self._half_m = collision.half_width_m + collision.side_m
        self._ahead = collision.front_m + collision.stop_m, collision.rear_m  # m, of the base that drives on
        self._behind = collision.front_m, collision.rear_m + collision.stop_m
        self._turning = collision.front_m, collision.rear_m
        # Around the origin, in motion and at rest, moving obstacles included.
        self._moving_room_m = max(self._half_m + settings.clearance_m, collision.front_m + collision.stop_m)
        self._standing_room_m = max(self._half_m, collision.front_m, collision.rear_m)
        self._width_m = collision.half_width_m
        self._front_m = collision.front_m
        self._avoiding = False
        self._edges = neighbours()
        speeds = np.append(np.linspace(0.0, SHARE * settings.pursuit.velocity_mps, SPEEDS), BACK_MPS)
        rates = np.linspace(-settings.pursuit.yaw_rate_radps, settings.pursuit.yaw_rate_radps, YAW_RATES)
        self._v, self._w = (grid.ravel() for grid in np.meshgrid(speeds, rates))
        t = np.linspace(0.0, ARC_S, ARC_STEPS + 1)
        turned = self._w[:, None] * t
        # Chord of an arc: v t sin(w t / 2) / (w t / 2), in the direction w t / 2.
        chord = self._v[:, None] * t * np.sinc(turned / (2 * np.pi))
        self._arc_x, self._arc_y = chord * np.cos(turned / 2), chord * np.sin(turned / 2)
        self._turned = turned

    def restart(self) -> None:
        """Forget the detour of the last drive."""
        self._avoiding = False

    def plan(
        self,
        pose: Array,
        path: Array,
        obstacles: Array,
        wanted: Setpoint,
        *,
        leg_left_m: float = math.inf,
        moving: Forecast | None = None,
        speed_mps: float = 0.0,
        unknown: Array = NOWHERE,
    ) -> Detour:
        """Return the motion: the wanted one where the path is free, else one around the obstacles, or none.

        pose: x, y, yaw (3,). path: (N, 2) from the nearest point on, some 5 cm apart. obstacles: (M, 2), with those of
        `moving` among them. wanted: the motion on the path. leg_left_m: distance to the next corner; obstacles beyond
        it do not matter yet. speed_mps: measured speed of the base. unknown (M, 2): places that are obstacles, too,
        where there is a way around them; else the collision monitor decides how near to them the base may come.
        """
        if len(unknown):
            around = np.vstack([obstacles, unknown])
            detour = self.plan(pose, path, around, wanted, leg_left_m=leg_left_m, moving=moving, speed_mps=speed_mps)
            if detour.setpoint is not None:
                return detour
        # 1. Without moving obstacles, or without a motion forwards, only obstacles at rest count.
        if moving is None or not (self._avoiding or wanted.velocity_mps > 0):
            return self._around_standing(pose, path, obstacles, wanted, leg_left_m, None)
        # 2. The share of the speed at which the base gives way to moving obstacles.
        pursuit = self._settings.pursuit
        pace = Pace(
            max(speed_mps, 0.0),
            pursuit.velocity_mps,
            pursuit.acceleration_mps2,
            self._moving_room_m,
            self._standing_room_m,
        )
        share, coming = yielding(path, leg_left_m, moving, pace)
        # 3. The base goes around moving obstacles that would reach it where it waits for them.
        outlines = moving.outlines(coming, pose[:2], SHARE * pursuit.velocity_mps)
        obstacles = np.vstack([moving.others(obstacles), outlines])
        detour = self._around_standing(pose, path, obstacles, wanted, leg_left_m, moving)
        if share == 1.0 or detour.avoiding or detour.setpoint is None:
            return detour
        return Detour(_slower(detour.setpoint, share * pursuit.velocity_mps) if share else None, False, CROSSES)

    def _around_standing(
        self, pose: Array, path: Array, obstacles: Array, wanted: Setpoint, leg_left_m: float, moving: Forecast | None
    ) -> Detour:
        """Return the motion along the path, around an obstacle on it, or up to the obstacle."""
        settings = self._settings
        offset_m = float(np.hypot(*(path[0] - pose[:2])))
        if not len(obstacles) or not (self._avoiding or wanted.velocity_mps > 0):
            self._avoiding = self._avoiding and bool(len(obstacles))
            return Detour(wanted, False)
        # 1. The first point of the path that is too near to an obstacle.
        ways = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(path, axis=0).T))])
        near = ways <= min(AHEAD_M, leg_left_m + CELL_M)
        room_m = _distances(path, obstacles)
        is_blocked = room_m < self._half_m + settings.clearance_m
        if is_blocked[0] and _gets_farther(room_m):  # it is there already, and drives away
            is_blocked[: len(ways) if is_blocked.all() else np.argmin(is_blocked)] = False
        first_m = float(ways[np.argmax(is_blocked)]) if is_blocked[near].any() else math.inf
        if first_m == math.inf and (not self._avoiding or offset_m < BACK_ON_PATH_M):
            self._avoiding = False
            return Detour(wanted, False)
        # 2. A free point of the path behind the obstacle, and the distances to it within the corridor.
        goal = _rejoin(ways, is_blocked, first_m if first_m < math.inf else 0.0)
        if goal is not None and settings.corridor_m > 0:
            motion = self._around(pose, path, obstacles, path[goal], moving)
            if motion is not None:
                self._avoiding = True
                return Detour(motion, True)
        # 3. Without a way around it, drive up to the obstacle and wait.
        left_m = first_m - self._front_m - BEFORE_M
        if self._avoiding or left_m <= 0:
            return Detour(None, self._avoiding, STANDS)
        return Detour(_slower(wanted, math.sqrt(2 * WAIT_MPS2 * left_m)), False)

    def _around(
        self, pose: Array, path: Array, obstacles: Array, goal: Array, moving: Forecast | None
    ) -> Setpoint | None:
        """Return the arc of least cost to a goal (2,) on the path; None where none is free."""
        # 1. Cells that are free: far enough from obstacles, or as far as the base is now, and within the corridor.
        settings = self._settings
        corner = pose[:2] - HALF_CELLS * CELL_M
        room_m = grid_distances(obstacles, corner)
        own_m = max(0.0, float(room_m[HALF_CELLS, HALF_CELLS]) - CELL_M)
        least_m = min(self._half_m + 0.5 * settings.clearance_m, own_m)
        is_free = (room_m > least_m) & (grid_distances(path, corner) <= settings.corridor_m)
        is_free[HALF_CELLS, HALF_CELLS] = True
        # 2. The length of the way from each cell to the goal, where narrow places count as longer.
        wide_m = self._half_m + 3 * settings.clearance_m
        narrow = 1.0 + NARROW * np.clip((wide_m - room_m) / wide_m, 0, 1)
        left_m = wave_front(self._edges, is_free, narrow, to_cells(goal[None], corner)[0])
        if left_m is None or left_m[HALF_CELLS, HALF_CELLS] >= FAR_M:
            return None
        # 3. The arcs that keep clear of obstacles and let moving ones pass.
        c, s = math.cos(pose[2]), math.sin(pose[2])
        places = pose[:2] + np.stack([c * self._arc_x - s * self._arc_y, s * self._arc_x + c * self._arc_y], axis=-1)
        cells = to_cells(places, corner)
        clear_m = room_m[cells[..., 1], cells[..., 0]].min(axis=1)
        rows, columns = cells[:, -1, 1], cells[:, -1, 0]
        way_m = left_m[rows, columns]
        is_open = self._keeps_clear(pose, obstacles) & (way_m < FAR_M) & is_free[rows, columns]
        if moving is not None:
            is_open &= self._lets_pass(places, moving)
        # 4. The cost of an arc: way left at its end, difference of its heading from the way, narrowness, backing up.
        down = descent(left_m, rows, columns)
        off = np.abs(np.remainder(pose[2] + self._turned[:, -1] - down + np.pi, 2 * np.pi) - np.pi)
        cost = way_m + HEADING_M_PER_RAD * off + BACK_WEIGHT_M * (self._v < 0)
        cost += CLEARANCE_WEIGHT_M * np.clip((wide_m - clear_m) / wide_m, 0, 1)
        cost = np.where(is_open & ((self._v != 0) | (self._w != 0)), cost, np.inf)
        best = int(np.argmin(cost))
        return Setpoint(float(self._v[best]), None, float(self._w[best])) if np.isfinite(cost[best]) else None

    def _keeps_clear(self, pose: Array, obstacles: Array) -> NDArray[np.bool_]:
        """Return which arcs keep the room that the collision monitor demands on the side to which the base moves."""
        c, s = math.cos(pose[2]), math.sin(pose[2])
        d = obstacles - pose[:2]
        d = d[np.hypot(d[:, 0], d[:, 1]) < NEAR_M]
        x, y = c * d[:, 0] + s * d[:, 1], c * d[:, 1] - s * d[:, 0]
        dx, dy = x - self._arc_x[..., None], y - self._arc_y[..., None]
        cos, sin = np.cos(self._turned)[..., None], np.sin(self._turned)[..., None]
        along, across = cos * dx + sin * dy, np.abs(cos * dy - sin * dx)
        reach = np.array([self._turning if v == 0 else self._ahead if v > 0 else self._behind for v in self._v])
        inside = (
            (along < reach[:, 0, None, None] + MARGIN_M)
            & (along > -reach[:, 1, None, None] - MARGIN_M)
            & (across < self._half_m + MARGIN_M)
        )
        # An obstacle that is within that room already must not come nearer to the outline.
        gap_m = np.hypot(
            np.maximum(np.maximum(along - self._turning[0], -self._turning[1] - along), 0.0),
            np.maximum(across - self._width_m, 0.0),
        )
        nearer = (gap_m < gap_m[:, :1] - NEARER_M).any(axis=1)
        hits = np.where(inside[:, 0], nearer, inside.any(axis=1))
        return np.asarray(~hits.any(axis=1))

    def _lets_pass(self, places: Array, moving: Forecast) -> NDArray[np.bool_]:
        """Return which arcs, with places (A, T, 2) at T times, meet no moving obstacle, or lead away from it."""
        others, radii = moving.at(np.linspace(0.0, ARC_S, ARC_STEPS + 1))
        gap_m = np.linalg.norm(others[:, None] - places, axis=-1) - radii[:, None] - self._standing_room_m
        least_m = np.minimum(0.0, gap_m[..., :1]) - NEARER_M
        return np.asarray((gap_m >= least_m).all(axis=(0, 2)))


def room_ahead(pose: Array, speed_mps: float, obstacles: Array) -> float:
    """Return the distance from a pose (3,) to the nearest obstacle (N, 2) that is not behind the moving base."""
    if not len(obstacles):
        return math.inf
    sign = -1.0 if speed_mps < 0 else 1.0
    dx, dy = obstacles[:, 0] - pose[0], obstacles[:, 1] - pose[1]
    distance = np.hypot(dx, dy)
    forward = sign * (math.cos(pose[2]) * dx + math.sin(pose[2]) * dy)
    return float(distance[forward > BEHIND_SHARE * distance].min(initial=math.inf))


def _slower(wanted: Setpoint, speed_mps: float) -> Setpoint:
    """Return the motion on the same arc, limited to a speed."""
    if wanted.velocity_mps <= speed_mps:
        return wanted
    share = speed_mps / wanted.velocity_mps
    return Setpoint(speed_mps, wanted.heading_rad, wanted.yaw_rate_radps * share)


def _distances(points: Array, obstacles: Array) -> Array:
    """Return the distance of each point (N, 2) to the nearest obstacle (M, 2)."""
    return np.asarray(np.hypot(points[:, None, 0] - obstacles[:, 0], points[:, None, 1] - obstacles[:, 1]).min(axis=1))


def _gets_farther(room_m: Array) -> bool:
    """True if the distances (N,) from the obstacles grow along the first points of a path."""
    k = min(len(room_m) - 1, 6)
    return bool((np.diff(room_m[: k + 1]) >= -1e-9).all())


def _rejoin(ways: Array, is_blocked: NDArray[np.bool_], first_m: float) -> int | None:
    """Return the index of a point behind the obstacle about which REJOIN_M of the path are free; None without one.

    ways: (N,) distances along the path. first_m: where the obstacle begins.
    """
    behind = (ways > first_m) & ~is_blocked & (ways < REJOIN_WITHIN_M)
    span = max(1, round(REJOIN_M / CELL_M))
    for k in np.flatnonzero(behind):
        if not is_blocked[k : k + span].any() and (ways[k] - first_m >= REJOIN_M or k == len(ways) - 1):
            return min(int(k) + span // 2, len(ways) - 1)
    return None
