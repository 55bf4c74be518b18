"""The way to a place: one search over poses on the floor, whose moves are arcs ahead, arcs back and turns on the spot.

Hybrid A* (Dolgov, Thrun, Montemerlo, Diebel 2010, "Path planning for autonomous vehicles in unknown semi-structured
environments", IJRR 29(5)) on a lattice of arcs (Pivtoraiko, Kelly 2005). The cost is time, at the speeds that are
driven near obstacles; the lower bound of the time left is a wave front over the cells. The outline, with the room that
the collision monitor demands on the side of each move, is covered by discs: what is found can be driven. What is not
seen to be occupied counts as free: the collision monitor decides how far the base may drive into it.
"""

from __future__ import annotations

import math
from typing import Final

import cv2
import numpy as np
from numpy.typing import NDArray

from omnid.core.control.collision_monitor import CollisionSettings
from omnid.core.navigation.lattice_kernels import HEADINGS, search, wave_front
from omnid.core.navigation.path import DrivePath, drive_path
from omnid.core.navigation.settings import NavigationSettings

Array = NDArray[np.float64]

CELL_M: Final = 0.05
HALF_CELLS: Final = 128  # half the side of the grid about the base: as far as obstacles are seen
MOVE_CELLS: Final = 3.0  # length of an arc, which leaves its cell in any direction
BACK_MPS: Final = 0.2  # slower than forwards, because people do not expect a robot to back up
MARGIN_M: Final = 0.02  # room for errors of the grid and of the base on its way
FAR_M: Final = 1e3  # distance where there is no obstacle


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
        count = math.ceil(longest_m / self.room_m)
        reach_m = longest_m / (2 * count)
        self._radius_m = math.hypot(self.room_m + MARGIN_M, reach_m)
        self._discs = np.array([np.linspace(begin + reach_m, end - reach_m, count) for begin, end in spans]) / CELL_M
        # 2. The moves: signed way in cells, turn, least time, kind.
        turn_rad = math.tau / HEADINGS
        turn_s = turn_rad / pursuit.yaw_rate_radps
        back_s = MOVE_CELLS * CELL_M / BACK_MPS
        self._moves = np.array(
            [(MOVE_CELLS, turn, abs(turn) / turn_rad * turn_s, 0.0) for turn in (0.0, -turn_rad, turn_rad)]
            + [
                (-MOVE_CELLS, turn, max(back_s, abs(turn) / turn_rad * turn_s), 1.0)
                for turn in (0.0, -turn_rad, turn_rad)
            ]
            + [(0.0, turn, turn_s, 2.0) for turn in (-turn_rad, turn_rad)]
        )
        self._limits = np.array(
            [
                self._radius_m,
                pursuit.velocity_mps / pursuit.acceleration_mps2,
                MOVE_CELLS * CELL_M / pursuit.velocity_mps,
            ]
        )

    def way(
        self, pose: Array, goal: Array, obstacles: Array, along: Array | None = None, heading_rad: float = math.nan
    ) -> DrivePath | str:
        """Return the fastest way from a pose (3,) to a goal (2,), or to the edge of the grid towards it, or why none.

        obstacles (N, 2). along (M, 2): a path from which the way is not farther than corridor_m; None: it may lead
        anywhere. heading_rad: at the goal, within a step of the search; NaN: any. All in odom.
        """
        # 1. Time across each cell, by the speed that is driven at its distance from obstacles.
        pursuit, corner = self._settings.pursuit, pose[:2] - HALF_CELLS * CELL_M
        room_m = _grid_distances(obstacles, corner)
        gap = (room_m - self._half_width_m) / pursuit.slow_obstacle_m
        speed_mps = pursuit.velocity_mps * np.clip(gap, pursuit.least_mps / pursuit.velocity_mps, 1.0)
        cell_s = np.where(room_m < self.room_m, np.inf, CELL_M / speed_mps)
        if along is not None:
            cell_s[_grid_distances(along, corner) > self._settings.corridor_m] = np.inf
        cell_s[HALF_CELLS, HALF_CELLS] = CELL_M / pursuit.least_mps
        # 2. Lower bound of the time left from each cell; beyond the grid the way is straight.
        left_s = np.full_like(cell_s, np.inf)
        at = (goal - corner) / CELL_M
        column, row = at.round().astype(int).tolist()
        is_inside = 0 <= row < len(left_s) and 0 <= column < len(left_s)
        if is_inside:
            if math.isinf(cell_s[row, column]):
                return f"something stands {_nearest_m(goal, obstacles):.1f} m from the goal"
            left_s[row, column] = 0.0
        elif along is None:
            for edge in (np.s_[0, :], np.s_[-1, :], np.s_[:, 0], np.s_[:, -1]):
                rows, columns = np.mgrid[: len(left_s), : len(left_s)]
                away_m = CELL_M * np.hypot(rows[edge] - at[1], columns[edge] - at[0])
                left_s[edge] = np.where(np.isinf(cell_s[edge]), np.inf, away_m / pursuit.velocity_mps)
        wave_front(cell_s, left_s)
        if math.isinf(left_s[HALF_CELLS, HALF_CELLS]):
            return f"what stands {_nearest_m(pose[:2], obstacles):.1f} m away closes every way"
        # 3. The way.
        if not is_inside:  # up to the edge of the grid
            edge_s = left_s.copy()
            margin = int(MOVE_CELLS)
            edge_s[margin:-margin, margin:-margin] = np.inf
            left_s[np.isfinite(edge_s)] = 0.0
        start = np.array([HALF_CELLS, HALF_CELLS, pose[2]], np.float64)
        found = search(room_m, cell_s, left_s, start, self._moves, self._discs, np.append(self._limits, heading_rad))
        if len(found) == 0:
            return "the base does not fit through"
        return self._path(pose, goal if is_inside else None, corner, found)

    def _path(self, pose: Array, goal: Array | None, corner: Array, found: Array) -> DrivePath:
        """Return the path through poses (K, 4) of a search, up to the goal."""
        xy, kinds = corner + CELL_M * found[:, :2], self._moves[found[:, 3].astype(int), 3]
        is_back = kinds == 1.0
        moves = np.append(True, kinds[1:] != 2.0)
        xy, is_back = xy[moves], is_back[moves]
        xy[0] = pose[:2]
        if len(is_back) > 1:
            is_back[0] = is_back[1]
        if goal is not None:
            xy, is_back = np.vstack([xy, goal]), np.append(is_back, False)
        speeds = np.where(is_back, BACK_MPS, self._settings.pursuit.velocity_mps)
        return drive_path(xy, speeds=speeds, backwards=[bool(back) for back in is_back])


def _grid_distances(points: Array, corner: Array) -> Array:
    """Return the distance of each cell to the nearest point [m]."""
    size = 2 * HALF_CELLS + 1
    grid = np.ones((size, size), np.uint8)
    columns, rows = ((points - corner) / CELL_M).round().astype(np.intp).T
    inside = (columns >= 0) & (columns < size) & (rows >= 0) & (rows < size)
    grid[rows[inside], columns[inside]] = 0
    if not inside.any():
        return np.full((size, size), FAR_M)
    return np.asarray(cv2.distanceTransform(grid, cv2.DIST_L2, cv2.DIST_MASK_PRECISE) * CELL_M, np.float64)


def _nearest_m(place: Array, obstacles: Array) -> float:
    """Return the distance of a place (2,) from the nearest obstacle."""
    return float(distances(place[None], obstacles)[0])


def distances(points: Array, obstacles: Array) -> Array:
    """Return the distance of each point (N, 2) to the nearest obstacle (M, 2), FAR_M without any."""
    if not len(obstacles):
        return np.full(len(points), FAR_M)
    return np.asarray(np.hypot(points[:, None, 0] - obstacles[:, 0], points[:, None, 1] - obstacles[:, 1]).min(axis=1))
