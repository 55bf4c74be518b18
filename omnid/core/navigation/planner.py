"""The way to a place: one search over poses on the floor, whose moves are arcs ahead, arcs back and turns on the spot.

Hybrid A* (Dolgov, Thrun, Montemerlo, Diebel 2010, "Path planning for autonomous vehicles in unknown semi-structured
environments", IJRR 29(5)) on a lattice of arcs (Pivtoraiko, Kelly 2005). The cost is time, at the speeds that are
driven near obstacles; the lower bound of the time left is a wave front over the cells. The outline, with the room that
the collision monitor demands on the side of each move, is covered by discs: what is found can be driven. What moves is
an obstacle where it is predicted at the time of each move.
"""

from __future__ import annotations

import math
from enum import IntEnum
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from omnid.core.control.collision_monitor import CollisionSettings
from omnid.core.navigation.lattice_kernels import HEADINGS, search, wave_front
from omnid.core.navigation.path import DrivePath, drive_path, straight_leg
from omnid.core.navigation.settings import NavigationSettings
from omnid.core.navigation.surroundings import HORIZON_S, MEETING_S, Surroundings, distances_m
from omnid.core.obstacles.grid import CELL_M

Array = NDArray[np.float64]

MOVE_CELLS: Final = 3  # length of an arc, so that it leaves its cell in any direction
BACK_MPS: Final = 0.2  # slower than forwards, because people do not expect a robot to back up
MARGIN_M: Final = 0.2 * CELL_M  # room for errors of the grid and of the base on its way
# Speed that is planned through floor that was not seen: a detour over floor that was is preferred up to 4 times as far.
UNKNOWN_MPS: Final = 0.1
GOAL_SEEN_M: Final = 1.0  # An obstacle at the goal is seen well from this distance.


class Move(IntEnum):
    """Kind of a move."""

    AHEAD = 0
    BACK = 1
    TURN = 2  # on the spot


class Way(NamedTuple):
    """A way that was found."""

    path: DrivePath  # in odom
    # To the goal, from the end of the path straight on:
    time_s: float
    length_m: float


class Planner:
    """Searches ways in odom, within the grid."""

    def __init__(self, settings: NavigationSettings, collision: CollisionSettings) -> None:
        """collision: the outline of the base, and the room that the collision monitor demands."""
        self._settings, pursuit = settings, settings.pursuit
        self._half_width_m = collision.half_width_m
        self.required_m = collision.half_width_m + collision.side_m  # distance of obstacles from the middle of the base
        # 1. What must be free ahead of the origin and behind it in a move of each kind, covered by discs of one radius.
        front_m, rear_m, stop_m = collision.front_m, collision.rear_m, collision.stop_m
        spans = ((-rear_m, front_m + stop_m), (-rear_m - stop_m, front_m), (-rear_m, front_m))
        longest_m = max(end - begin for begin, end in spans)
        count = math.ceil(2 * longest_m / self.required_m)
        reach_m = longest_m / (2 * count)
        self._radius_m = math.hypot(self.required_m + MARGIN_M, reach_m)
        self._discs = np.array([np.linspace(begin + reach_m, end - reach_m, count) for begin, end in spans]) / CELL_M
        # 2. The moves: signed way in cells, turn, least time, kind.
        turn_rad = math.tau / HEADINGS
        turn_s, back_s = turn_rad / pursuit.yaw_rate_radps, MOVE_CELLS * CELL_M / BACK_MPS
        arcs = [(0.0, 0.0), (-turn_rad, turn_s), (turn_rad, turn_s)]
        self._moves = np.array(
            [(MOVE_CELLS, turn, least_s, Move.AHEAD) for turn, least_s in arcs]
            + [(-MOVE_CELLS, turn, max(back_s, least_s), Move.BACK) for turn, least_s in arcs]
            + [(0.0, turn, least_s, Move.TURN) for turn, least_s in arcs[1:]]
        )

    def is_straight_free(self, pose: Array, goal: Array, around: Surroundings, now_ns: int) -> bool:
        """True if a goal (2,) is ahead and nothing is on the straight way to it, with a cell to spare."""
        leg, least_m = straight_leg(pose, goal), self.required_m + self._settings.clearance_m + CELL_M
        if math.cos(float(leg.heading[0] - pose[2])) < math.cos(math.pi / 4):
            return False
        speed_mps = self._settings.pursuit.velocity_mps
        return bool(
            math.isinf(around.first_blocked_m(leg.xy, least_m, now_ns, speed_mps))
            and around.distance_at(leg.xy, distances_m(around.is_unknown)).min() >= least_m
        )

    def way(
        self,
        pose: Array,
        goal: Array,
        around: Surroundings,
        now_ns: int,
        *,
        along: Array | None = None,
        heading_rad: float = math.nan,
        barred: Move | None = None,
    ) -> Way | str:
        """Return the fastest way from a pose (3,) to a goal (2,), or to the edge of the grid towards it, or why none.

        along (M, 2): a path from which the way is not farther than corridor_m; None: it may lead anywhere. heading_rad:
        at the goal, within a step of the search; NaN: any. barred: the collision monitor has stopped such a move here,
        so that the way begins with another one. All in odom.
        """
        # Cells are counted between their middles.
        origin, velocity_mps = around.grid.corner_m + 0.5 * CELL_M, self._settings.pursuit.velocity_mps
        at, start = ((place - origin) / CELL_M for place in (goal, pose[:2]))
        start = start.clip(0, len(around.is_unknown) - 1)
        cell_s = self._times(start, around, along)
        # 1. Lower bound of the time left from each cell; beyond the grid the way is straight.
        left_s, is_open, size = np.full_like(cell_s, np.inf), np.isfinite(cell_s), len(cell_s)
        rows, columns = np.indices(cell_s.shape)
        away_m = CELL_M * np.hypot(rows - at[1], columns - at[0])
        is_edge = (np.minimum(rows, columns) == 0) | (np.maximum(rows, columns) == size - 1)
        column, row = at.round().astype(int).tolist()
        is_inside = 0 <= row < size and 0 <= column < size
        is_free = is_inside and bool(is_open[row, column])
        if is_free:
            left_s[row, column] = 0.0
        elif is_inside:
            # An obstacle seen from afar at the goal may be next to it: drive as near as is free, to see it better.
            least_m = float(away_m[is_open].min())
            if math.dist(goal, pose[:2]) < least_m + GOAL_SEEN_M:
                return f"an obstacle is {around.closed_distance_m[row, column]:.1f} m from the goal"
            left_s[is_open & (away_m < least_m + 2 * CELL_M)] = 0.0
        elif along is None:
            left_s[is_edge & is_open] = away_m[is_edge & is_open] / velocity_mps
        wave_front(cell_s, left_s)
        own = round(start[1]), round(start[0])
        if math.isinf(left_s[own]):
            return f"an obstacle {around.closed_distance_m[own]:.1f} m away closes every way"
        # 2. The way, which ends at the edge of the grid if the goal is beyond.
        if not is_inside:
            inner = np.s_[MOVE_CELLS:-MOVE_CELLS, MOVE_CELLS:-MOVE_CELLS]
            is_edge = np.isfinite(left_s)
            is_edge[inner] = False
            left_s[is_edge] = 0.0
        # What moves may turn: it is passed with the clearance to obstacles.
        movers = (around.movers(now_ns) - [*origin, 0.0, 0.0, -self._settings.clearance_m]) / CELL_M
        change_s = velocity_mps / self._settings.pursuit.acceleration_mps2
        done_s, first = MOVE_CELLS * CELL_M / velocity_mps, -1 if barred is None else barred
        limits = self._radius_m, change_s, done_s, heading_rad, first, CELL_M, MEETING_S, HORIZON_S
        begin, limits_array = np.append(start, pose[2]), np.array(limits, np.float64)
        grids = around.closed_distance_m, cell_s, left_s
        found = search(*grids, begin, self._moves, self._discs, movers, limits_array)
        if len(found) == 0:
            return "the base does not fit through"
        # 3. Its points and its time; turns on the spot are the corners of a path.
        xy, of_moves = origin + CELL_M * found[:, :2], self._moves[found[1:, 3].astype(int)]
        columns, rows = found[1:, :2].round().astype(int).T
        time_s = float(np.maximum(of_moves[:, 2], np.abs(of_moves[:, 0]) * cell_s[rows, columns]).sum())
        moves = of_moves[:, 3] != Move.TURN
        xy = np.vstack([pose[None, :2], xy[1:][moves]])
        speeds = np.where(of_moves[moves, 3] == Move.BACK, -BACK_MPS, velocity_mps)
        speeds = np.append(speeds[:1] if len(speeds) else velocity_mps, speeds)
        if is_free:
            xy, speeds = np.vstack([xy, goal]), np.append(speeds, velocity_mps)
        else:
            time_s += math.dist(xy[-1], goal) / velocity_mps
        if len(xy) < 2:
            return "the base does not fit through"
        path = drive_path(xy, speeds=speeds)
        return Way(path, time_s, path.length_m + math.dist(path.goal, goal))

    def _times(self, start: Array, around: Surroundings, along: Array | None) -> Array:
        """Return the time across each cell [s], inf where the base cannot be, or may not; start (2,): its cell."""
        # 1. By the speed that is driven at this distance from obstacles, and through floor that was not seen.
        pursuit, distance_m = self._settings.pursuit, around.closed_distance_m
        gap = (distance_m - self._half_width_m) / pursuit.slow_obstacle_m
        # What is passed at the least speed costs more where it is nearer, so that the way is in the middle of a gap.
        speed_mps = pursuit.velocity_mps * np.clip(gap, MARGIN_M / pursuit.slow_obstacle_m, 1.0)
        speed_mps[around.is_unknown] = np.minimum(speed_mps[around.is_unknown], UNKNOWN_MPS)
        # 2. A base that begins too near to an obstacle may drive away from it.
        rows, columns = np.indices(distance_m.shape)
        own = np.s_[round(start[1]), round(start[0])]
        is_near = CELL_M * np.hypot(rows - start[1], columns - start[0]) < self._radius_m
        least_m = np.where(is_near, np.minimum(self.required_m, distance_m[own]), self.required_m)
        cell_s = np.where(distance_m < least_m, np.inf, CELL_M / speed_mps)
        # 3. Only near the path, if one is given.
        if along is not None:
            at = [index.clip(0, len(distance_m) - 1) for index in around.grid.at(along)]
            is_path = np.zeros(distance_m.shape, bool)
            is_path[at[0], at[1]] = True
            cell_s[distances_m(is_path) > self._settings.corridor_m] = np.inf
        cell_s[own] = CELL_M / pursuit.least_mps
        return cell_s
