"""The way to a place: one search over poses on the floor, whose moves are arcs ahead, arcs back and turns on the spot.

Hybrid A* (Dolgov, Thrun, Montemerlo, Diebel 2010, "Path planning for autonomous vehicles in unknown semi-structured
environments", IJRR 29(5)) on a lattice of arcs (Pivtoraiko, Kelly 2005). The cost is time, at the speeds that are
driven near obstacles; the lower bound of the time left is a wave front over the cells. The outline, with the room that
the collision monitor demands on the side of each move, is covered by discs: what is found can be driven. Floor that was
not seen has a cost, as it may be seen when the base comes near; where it was not seen then is an obstacle.
"""

from __future__ import annotations

import math
from enum import IntEnum
from typing import Final, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from omnid.core.control.collision_monitor import CollisionSettings
from omnid.core.navigation.floor_map import CELL_M, HALF_CELLS, OCCUPIED, SIDE, UNKNOWN, FloorMap, cells_of
from omnid.core.navigation.lattice_kernels import HEADINGS, search, wave_front
from omnid.core.navigation.path import DrivePath, drive_path
from omnid.core.navigation.settings import NavigationSettings

Array = NDArray[np.float64]

MOVE_CELLS: Final = 3.0  # length of an arc, which leaves its cell in any direction
BACK_MPS: Final = 0.2  # slower than forwards, because people do not expect a robot to back up
MARGIN_M: Final = 0.01  # room for errors of the grid and of the base on its way
FAR_M: Final = 1e3  # distance where there is no obstacle
# Speed that is planned through floor that was not seen: a detour over floor that was is preferred up to 4 times as far.
UNKNOWN_MPS: Final = 0.1
LOOK_M: Final = 1.0  # Nearer than that to what stands at the goal it is seen well.


class Move(IntEnum):
    """Kind of a move."""

    AHEAD = 0
    BACK = 1
    TURN = 2  # on the spot


class Way(NamedTuple):
    """A way that was found."""

    path: DrivePath  # in odom
    time_s: float


class Surroundings(NamedTuple):
    """What is known about the base, in odom."""

    obstacles: Array  # (N, 2) positions
    floor: FloorMap | None = None  # None: all floor counts as seen


class Planner:
    """Searches ways in odom, about the base."""

    def __init__(self, settings: NavigationSettings, collision: CollisionSettings) -> None:
        """collision: the outline of the base, and the room that the collision monitor demands."""
        self._settings, pursuit = settings, settings.pursuit
        self._half_width_m = collision.half_width_m
        self.room_m = collision.half_width_m + collision.side_m  # least, beside the middle of the base
        # 1. What must be free ahead of the origin and behind it in a move of each kind, covered by discs of one radius.
        front_m, rear_m, stop_m = collision.front_m, collision.rear_m, collision.stop_m
        spans = ((-rear_m, front_m + stop_m), (-rear_m - stop_m, front_m), (-rear_m, front_m))
        longest_m = max(end - begin for begin, end in spans)
        count = math.ceil(2 * longest_m / self.room_m)
        reach_m = longest_m / (2 * count)
        self._radius_m = math.hypot(self.room_m + MARGIN_M, reach_m)
        self._discs = np.array([np.linspace(begin + reach_m, end - reach_m, count) for begin, end in spans]) / CELL_M
        # 2. The moves: signed way in cells, turn, least time, kind.
        turn_rad = math.tau / HEADINGS
        turn_s = turn_rad / pursuit.yaw_rate_radps
        back_s = MOVE_CELLS * CELL_M / BACK_MPS
        arcs = [(0.0, 0.0), (-turn_rad, turn_s), (turn_rad, turn_s)]
        self._moves = np.array(
            [(MOVE_CELLS, turn, least_s, Move.AHEAD) for turn, least_s in arcs]
            + [(-MOVE_CELLS, turn, max(back_s, least_s), Move.BACK) for turn, least_s in arcs]
            + [(0.0, turn, least_s, Move.TURN) for turn, least_s in arcs[1:]]
        )
        self._change_s = pursuit.velocity_mps / pursuit.acceleration_mps2
        self._move_s = MOVE_CELLS * CELL_M / pursuit.velocity_mps

    def way(
        self,
        pose: Array,
        goal: Array,
        around: Surroundings,
        along: Array | None = None,
        heading_rad: float = math.nan,
        barred: Move | None = None,
    ) -> Way | str:
        """Return the fastest way from a pose (3,) to a goal (2,), or to the edge of the map towards it, or why none.

        along (M, 2): a path from which the way is not farther than corridor_m; None: it may lead anywhere. heading_rad:
        at the goal, within a step of the search; NaN: any. barred: the collision monitor has stopped such a move here,
        so that the way begins with another one. All in odom.
        """
        corner = FloorMap.corner(pose)
        room_m, cell_s = self._costs(pose, around, along)
        # 1. Lower bound of the time left from each cell; beyond the map the way is straight.
        left_s = np.full_like(cell_s, np.inf)
        at = (goal - corner) / CELL_M
        column, row = at.round().astype(int).tolist()
        is_inside = 0 <= row < SIDE and 0 <= column < SIDE
        is_free = is_inside and math.isfinite(cell_s[row, column])
        if is_free:
            left_s[row, column] = 0.0
        elif is_inside:
            # What looks from afar as if it stood at the goal may be beside it: as near as it is free, to look.
            rows, columns = np.indices((SIDE, SIDE))
            away_m = CELL_M * np.hypot(rows - at[1], columns - at[0])
            least_m = float(away_m[np.isfinite(cell_s)].min())
            if math.dist(goal, pose[:2]) < least_m + LOOK_M:
                return f"something stands {_nearest_m(goal, around):.1f} m from the goal"
            left_s[np.isfinite(cell_s) & (away_m < least_m + 2 * CELL_M)] = 0.0
        elif along is None:
            rows, columns = np.mgrid[:SIDE, :SIDE]
            is_edge = np.zeros((SIDE, SIDE), bool)
            is_edge[[0, -1]] = is_edge[:, [0, -1]] = True
            is_edge &= np.isfinite(cell_s)
            away_m = CELL_M * np.hypot(rows[is_edge] - at[1], columns[is_edge] - at[0])
            left_s[is_edge] = away_m / self._settings.pursuit.velocity_mps
        wave_front(cell_s, left_s)
        if math.isinf(left_s[HALF_CELLS, HALF_CELLS]):
            return f"what stands {_nearest_m(pose[:2], around):.1f} m away closes every way"
        # 2. The way, which ends at the edge of the map if the goal is beyond.
        if not is_inside:
            margin = int(MOVE_CELLS)
            inner = np.s_[margin:-margin, margin:-margin]
            is_edge = np.isfinite(left_s)
            is_edge[inner] = False
            left_s[is_edge] = 0.0
        found = self._search(pose, corner, room_m, cell_s, left_s, heading_rad, barred)
        if len(found) == 0:
            return "the base does not fit through"
        return self._way(pose, goal if is_free else None, corner, found, cell_s)

    def free_s(self, pose: Array, xy: Array, around: Surroundings) -> float:
        """Return the time along points (N, 2) from a pose (3,) on, if nothing stood on them."""
        _, cell_s = self._costs(pose, around, None)
        steps_m, (columns, rows) = (
            np.hypot(*np.diff(xy, axis=0).T),
            ((xy[1:] - FloorMap.corner(pose)) / CELL_M).round().astype(int).T,
        )
        is_inside = (np.minimum(rows, columns) >= 0) & (np.maximum(rows, columns) < SIDE)
        times_s = cell_s[rows.clip(0, SIDE - 1), columns.clip(0, SIDE - 1)]
        times_s[np.isinf(times_s)] = CELL_M / self._settings.pursuit.velocity_mps
        per_cell_s = np.where(is_inside, times_s, CELL_M / UNKNOWN_MPS)
        return float((steps_m * per_cell_s).sum() / CELL_M)

    def _costs(self, pose: Array, around: Surroundings, along: Array | None) -> tuple[Array, Array]:
        """Return the distance of each cell to obstacles [m], and the time across it [s]."""
        # 1. Time by the speed that is driven at this distance from obstacles.
        pursuit, corner = self._settings.pursuit, FloorMap.corner(pose)
        is_occupied = np.zeros((SIDE, SIDE), bool)
        is_occupied[cells_of(around.obstacles, corner)] = True
        states = None if around.floor is None else around.floor.states(pose)
        if states is not None:
            is_occupied |= states == OCCUPIED
        room_m = _distances(is_occupied)
        gap = (room_m - self._half_width_m) / pursuit.slow_obstacle_m
        speed_mps = pursuit.velocity_mps * np.clip(gap, pursuit.least_mps / pursuit.velocity_mps, 1.0)
        # 2. Floor that was not seen.
        if states is not None:
            is_unknown = states == UNKNOWN
            speed_mps[is_unknown] = np.minimum(speed_mps[is_unknown], UNKNOWN_MPS)
        # 3. Where the base cannot be, or may not.
        # A base that begins too near to something may leave, as far as it gets no nearer.
        away_m = CELL_M * np.hypot(*(np.indices((SIDE, SIDE)) - HALF_CELLS))
        least_m = np.where(
            away_m < self._radius_m, np.minimum(self.room_m, room_m[HALF_CELLS, HALF_CELLS]), self.room_m
        )
        cell_s = np.where(room_m < least_m, np.inf, CELL_M / speed_mps)
        if along is not None:
            is_path = np.zeros((SIDE, SIDE), bool)
            is_path[cells_of(along, corner)] = True
            cell_s[_distances(is_path) > self._settings.corridor_m] = np.inf
        cell_s[HALF_CELLS, HALF_CELLS] = CELL_M / pursuit.least_mps
        return room_m, cell_s

    def _search(
        self,
        pose: Array,
        corner: Array,
        room_m: Array,
        cell_s: Array,
        left_s: Array,
        heading_rad: float = math.nan,
        barred: Move | None = None,
    ) -> Array:
        start = np.append((pose[:2] - corner) / CELL_M, pose[2])
        limits = (self._radius_m, self._change_s, self._move_s, heading_rad, -1 if barred is None else barred)
        return search(room_m, cell_s, left_s, start, self._moves, self._discs, np.array(limits, np.float64))

    def _way(self, pose: Array, goal: Array | None, corner: Array, found: Array, cell_s: Array) -> Way:
        """Return the way through poses (K, 4) of a search, up to the goal."""
        xy, of_moves = corner + CELL_M * found[:, :2], self._moves[found[1:, 3].astype(int)]
        columns, rows = found[1:, :2].round().astype(int).T
        time_s = float(np.maximum(of_moves[:, 2], np.abs(of_moves[:, 0]) * cell_s[rows, columns]).sum())
        kinds = np.append(Move.AHEAD, of_moves[:, 3])
        is_back, moves = kinds == Move.BACK, kinds != Move.TURN
        xy, is_back = xy[moves], is_back[moves]
        xy[0] = pose[:2]
        if len(is_back) > 1:
            is_back[0] = is_back[1]
        if goal is not None:
            xy, is_back = np.vstack([xy, goal]), np.append(is_back, False)
        speeds = np.where(is_back, BACK_MPS, self._settings.pursuit.velocity_mps)
        return Way(drive_path(xy, speeds=speeds, backwards=[bool(back) for back in is_back]), time_s)


def _distances(flags: NDArray[np.bool_]) -> Array:
    """Return the distance of each cell to the nearest one that is set [m]."""
    if not flags.any():
        return np.full(flags.shape, FAR_M)
    return np.asarray(cv2.distanceTransform((~flags).view(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_PRECISE) * CELL_M, "f8")


def _nearest_m(place: Array, around: Surroundings) -> float:
    """Return the distance of a place (2,) from the nearest obstacle."""
    return float(distances(place[None], around.obstacles)[0])


def distances(points: Array, obstacles: Array) -> Array:
    """Return the distance of each point (N, 2) to the nearest obstacle (M, 2), FAR_M without any."""
    if not len(obstacles):
        return np.full(len(points), FAR_M)
    return np.asarray(np.hypot(points[:, None, 0] - obstacles[:, 0], points[:, None, 1] - obstacles[:, 1]).min(axis=1))
