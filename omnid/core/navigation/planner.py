"""What is about the base, and the way to a place in it: one search over poses, by arcs and by turns on the spot.

Hybrid A* (Dolgov, Thrun, Montemerlo, Diebel 2010, "Path planning for autonomous vehicles in unknown semi-structured
environments", IJRR 29(5)) on a lattice of arcs (Pivtoraiko, Kelly 2005). The cost is time, at the speeds that are
driven near obstacles and by the risk of the floor; the lower bound of the time left is a wave front over the cells. The
outline, with the room that the collision monitor demands on the side of each move, is covered by discs: what is found
can be driven. What moves keeps its velocity, and is an obstacle where the base would meet it.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Final

import cv2
import numpy as np
from numpy.typing import NDArray

from omnid.core.control.collision_monitor import CollisionSettings
from omnid.core.navigation.lattice_kernels import HEADINGS, rooms_along, search, wave_front
from omnid.core.navigation.path import DrivePath, drive_path
from omnid.core.navigation.settings import NavigationSettings
from omnid.core.obstacles.grid import CELL_M, FREE, OCCUPIED, UNKNOWN, FloorGrid
from omnid.core.obstacles.moving_tracker import MovingObstacle

Array = NDArray[np.float64]
Flags = NDArray[np.bool_]

MOVE_CELLS: Final = 3  # length of an arc, so that it leaves its cell in any direction
BACK_MPS: Final = 0.2  # slower than forwards, because people do not expect a robot to back up
UNKNOWN_COST: Final = 4.0  # A detour over floor that was seen is preferred up to so many times as far.
NEAR_M: Final = 1.2  # Floor nearer than that would be seen if it could be.
TRAIL_S: Final = 0.5  # The grid shows what moves where it was for this time, because pairs vote.
OWN_M: Final = 0.25  # beyond its radius, cells are those of what moves
SIGMA_M: Final = 0.2  # room for the uncertainty of what moves
SPECK: Final = np.ones((3, 3), np.uint8)  # unknown floor that is smaller stops no base


class Surroundings:
    """The grid of a pair with the room in it, and what moves; positions in odom."""

    def __init__(
        self,
        grid: FloorGrid,
        moving: Sequence[MovingObstacle] = (),
        stamp_ns: int = 0,
        pose: Array | None = None,
        before: Surroundings | None = None,
    ) -> None:
        """stamp_ns, pose (3,): of the pair. before: surroundings of an earlier pair, in the same odom."""
        self.grid, self.stamp_ns, states = grid, stamp_ns, grid.states
        self._movers = np.array([(m.x_m, m.y_m, m.vx_mps, m.vy_mps, m.radius_m) for m in moving]).reshape(-1, 5)
        # 1. Obstacles at rest: what moves is left out, with its trail.
        is_closed = states == OCCUPIED
        for x, y, vx, vy, radius_m in self._movers:
            behind_m = 0.5 * TRAIL_S * math.hypot(vx, vy)
            is_closed &= (
                self.away_m(np.array([x, y]) - 0.5 * TRAIL_S * np.array([vx, vy])) > radius_m + OWN_M + behind_m
            )
        # 2. Floor that was not seen although the base came near is closed until it is seen: more views show no more.
        is_patch = cv2.morphologyEx((states == UNKNOWN).view(np.uint8), cv2.MORPH_OPEN, SPECK) > 0
        is_unseen = np.zeros(states.shape, bool)
        if pose is not None:
            is_unseen = self.away_m(pose) < NEAR_M
        if before is not None:
            is_unseen |= self.cells(before._unseen)
        is_unseen &= is_patch
        self._unseen: Array = grid.corner_m + CELL_M * (np.argwhere(is_unseen)[:, ::-1] + 0.5)
        self._is_closed = is_closed | is_unseen
        self.room = distances(self._is_closed)  # of each cell, in cells

    @property
    def moves(self) -> bool:
        """True if something moves."""
        return len(self._movers) > 0

    def away_m(self, place: Array) -> Array:
        """Return the distance (N, N) of each cell from a place (2,)."""
        y, x = CELL_M * (np.indices(self.grid.occupied.shape) + 0.5)
        return np.asarray(np.hypot(x + self.grid.corner_m[0] - place[0], y + self.grid.corner_m[1] - place[1]))

    def cells(self, points: Array) -> Flags:
        """Return the cells in which points (N, 2) are."""
        flags = np.zeros(self.grid.occupied.shape, bool)
        rows, columns = self.grid.at(points)
        inside = (np.minimum(rows, columns) >= 0) & (np.maximum(rows, columns) < len(flags))
        flags[rows[inside], columns[inside]] = True
        return flags

    @property
    def seen_room(self) -> Array:
        """Distance of each cell from what is no floor that was seen [cells]."""
        return distances(self.grid.states != FREE)

    def room_with(self, barred: Sequence[Array]) -> Array:
        """Return the room of each cell [cells], where points (N, 2) are closed, too."""
        if not barred:
            return self.room
        return distances(self._is_closed | self.cells(np.concatenate(barred)))

    def in_cells(self, points: Array) -> Array:
        """Return points (N, 2) in cells, whose middles are integers."""
        return np.asarray((points - self.grid.corner_m) / CELL_M - 0.5)

    def movers(self, now_ns: int, room_m: float = 0.0) -> Array:
        """Return place, velocity and radius (K, 5) in cells of what moves, as predicted for now; room_m: more room."""
        now = self._movers.copy()
        now[:, :2] = self.in_cells(now[:, :2] + (now_ns - self.stamp_ns) * 1e-9 * now[:, 2:4])
        now[:, 2:] = (now[:, 2:] + [0.0, 0.0, SIGMA_M + room_m]) / CELL_M
        return now


def distances(flags: Flags) -> Array:
    """Return the distance of each cell to the nearest one that is set [cells]."""
    if not flags.any():
        return np.full(flags.shape, 1e4)
    return np.asarray(cv2.distanceTransform((~flags).view(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_PRECISE), "f8")


class Planner:
    """Searches ways in odom, within the grid."""

    def __init__(self, settings: NavigationSettings, collision: CollisionSettings) -> None:
        """collision: the outline of the base, and the room that the collision monitor demands."""
        self._settings, pursuit = settings, settings.pursuit
        self._half_width_m = collision.half_width_m
        self.room_m = collision.half_width_m + collision.side_m  # least, beside the middle of the base
        # 1. What must be free ahead of the origin and behind it in a move of each kind, covered by discs of one radius,
        #    with some room for errors of the grid and of the base on its way.
        front_m, rear_m, stop_m = collision.front_m, collision.rear_m, collision.stop_m
        spans = ((-rear_m, front_m + stop_m), (-rear_m - stop_m, front_m), (-rear_m, front_m))
        longest_m = max(end - begin for begin, end in spans)
        count = math.ceil(2 * longest_m / self.room_m)
        reach_m = longest_m / (2 * count)
        self._radius = math.hypot(self.room_m / CELL_M + 0.2, reach_m / CELL_M)
        self._discs = np.array([np.linspace(begin + reach_m, end - reach_m, count) for begin, end in spans]) / CELL_M
        # 2. The moves: signed way in cells, turn, least time.
        turn_rad = math.tau / HEADINGS
        turn_s, back_s = turn_rad / pursuit.yaw_rate_radps, MOVE_CELLS * CELL_M / BACK_MPS
        turns = [(-turn_rad, turn_s), (turn_rad, turn_s)]
        self._moves = np.array(
            [(MOVE_CELLS, turn, least_s) for turn, least_s in [(0.0, 0.0), *turns]]
            + [(-MOVE_CELLS, turn, max(back_s, least_s)) for turn, least_s in [(0.0, 0.0), *turns]]
            + [(0.0, turn, least_s) for turn, least_s in turns]
        )

    def is_blocked(self, xy: Array, around: Surroundings, room: Array, now_ns: int, more_m: float = 0.0) -> Flags:
        """Return where along points (N, 2) the base has less room than it needs, and so much more [m].

        room (N, N): of each cell, in cells. What the base is near to already, and drives away from, does not count.
        """
        ways_m = np.append(0.0, np.cumsum(np.hypot(*np.diff(xy, axis=0).T)))
        way = np.column_stack([around.in_cells(xy), ways_m / self._settings.pursuit.velocity_mps])
        rooms = rooms_along(room, around.movers(now_ns), way)
        is_near = rooms < (self.room_m + more_m) / CELL_M
        leaves = np.logical_and.accumulate(is_near & np.append(True, np.diff(rooms) > -0.1))
        return np.asarray(is_near & ~leaves)

    def way(
        self,
        pose: Array,
        goal: Array,
        around: Surroundings,
        room: Array,
        now_ns: int,
        along: Array | None = None,
        heading_rad: float = math.nan,
    ) -> DrivePath | str:
        """Return the fastest way from a pose (3,) to a goal (2,), or to the edge of the grid towards it, or why none.

        along (M, 2): a path from which the way is not farther than corridor_m; None: it may lead anywhere. heading_rad:
        at the goal, within a step of the search; NaN: any. All in odom. room (N, N): of each cell, in cells.
        """
        pursuit = self._settings.pursuit
        at, start = around.in_cells(goal), around.in_cells(pose[:2]).clip(0, len(room) - 1)
        rows, columns = np.indices(room.shape)
        own = np.s_[round(start[1]), round(start[0])]
        # 1. The time across each cell, by the room and by the risk there; inf where the base cannot be, or may not. A
        #    base that begins too near to something may leave, as far as it gets no nearer.
        gap = (CELL_M * room - self._half_width_m) / pursuit.slow_obstacle_m
        speed_mps = pursuit.velocity_mps * np.clip(gap, pursuit.least_mps / pursuit.velocity_mps, 1.0)
        speed_mps[around.grid.states == UNKNOWN] /= UNKNOWN_COST
        least = np.full(room.shape, self.room_m / CELL_M)
        least[around.away_m(pose) < self._radius * CELL_M] = min(self.room_m / CELL_M, room[own])
        cell_s = np.where(room < least, np.inf, CELL_M / speed_mps)
        if along is not None:
            cell_s[distances(around.cells(along)) * CELL_M > self._settings.corridor_m] = np.inf
        cell_s[own] = CELL_M / pursuit.least_mps
        # 2. Lower bound of the time left from each cell. Beyond the grid the way is straight. An obstacle that from
        #    afar seems to be at the goal may be beside it: drive as near as is free, to see.
        left_s, is_open, size = np.full_like(cell_s, np.inf), np.isfinite(cell_s), len(cell_s)
        away_m = around.away_m(goal)
        edge = np.minimum(np.minimum(rows, columns), size - 1 - np.maximum(rows, columns))
        column, row = at.round().astype(int).tolist()
        is_inside = 0 <= row < size and 0 <= column < size
        is_free = is_inside and bool(is_open[row, column])
        if is_free:
            left_s[row, column] = 0.0
        elif is_inside:
            least_m = float(away_m[is_open].min())
            if math.dist(goal, pose[:2]) < least_m + NEAR_M:
                return f"something is {CELL_M * room[row, column]:.1f} m from the goal"
            left_s[is_open & (away_m < least_m + 2 * CELL_M)] = 0.0
        elif along is None:
            left_s[(edge == 0) & is_open] = away_m[(edge == 0) & is_open] / pursuit.velocity_mps
        wave_front(cell_s, left_s)
        if math.isinf(left_s[own]):
            return f"what is {CELL_M * room[own]:.1f} m away closes every way"
        if not is_inside:
            left_s[(edge < MOVE_CELLS) & np.isfinite(left_s)] = 0.0
        # 3. The way. What moves may turn: it is passed with the clearance to obstacles.
        movers, done_s = around.movers(now_ns, self._settings.clearance_m), MOVE_CELLS * CELL_M / pursuit.velocity_mps
        change_s, of_base = pursuit.velocity_mps / pursuit.acceleration_mps2, np.append(start, pose[2])
        tables = of_base, self._moves, self._discs, movers, self._radius
        found = search(room, cell_s, left_s, *tables, change_s, done_s, heading_rad)
        # 4. Its points; turns on the spot are the corners of a path.
        cells = self._moves[found[1:, 5].astype(int), 0]
        xy, cells = around.grid.corner_m + CELL_M * (found[1:, :2][cells != 0] + 0.5), cells[cells != 0]
        if is_free and len(found):
            xy, cells = np.vstack([xy, goal]), np.append(cells, MOVE_CELLS)
        if not len(xy):
            return "the base does not fit through"
        speeds = np.where(cells > 0, pursuit.velocity_mps, -BACK_MPS)
        return drive_path(np.vstack([pose[None, :2], xy]), speeds=np.append(speeds[:1], speeds))
