"""The floor about the base, in odom: what the newest ring of obstacles shows, else what earlier ones did.

Floor is known, or an obstacle is; the rest is unknown. Where a base that is near sees floor to an end, so that the
collision monitor would stop it there, coming nearer shows no more: that end counts as an obstacle until it is seen.
"""

from __future__ import annotations

import math
from typing import Final

import cv2
import numpy as np
from numpy.typing import NDArray

from omnid.core.control.collision_geometry import Outline, sector_edges_m
from omnid.core.control.collision_monitor import CollisionSettings, unknown_ends

Array = NDArray[np.float64]
Ranges = NDArray[np.floating]
Cells = NDArray[np.uint8]

CELL_M: Final = 0.05
HALF_CELLS: Final = 128  # half the side of the map about the base: as far as obstacles are seen
SIDE: Final = 2 * HALF_CELLS + 1
NEAR_M: Final = 1.2  # Floor nearer than that would be seen if it could be.
UNKNOWN, FREE, OCCUPIED = 0, 1, 2


class FloorMap:
    """Cells (SIDE, SIDE) about that of the base, with which they move: UNKNOWN, FREE or OCCUPIED; rows are y."""

    def __init__(self, collision: CollisionSettings) -> None:
        """collision: the outline of the base."""
        self._outline = Outline(collision.front_m, collision.rear_m, collision.half_width_m)
        self._stop_m = collision.stop_m
        self._cell: NDArray[np.int64] | None = None  # of the base, in odom
        self._states: Cells = np.zeros((SIDE, SIDE), np.uint8)

    def add(self, pose: Array, ranges_m: Ranges, free_m: Ranges) -> None:
        """Take a ring at a pose x, y, yaw (3,) in odom.

        ranges_m (N,): of obstacles; free_m (N,): up to which floor was seen; sector k as in ObstacleRing.
        """
        self._follow(pose[:2])
        # 1. Floor that was seen, and that on which the base stands.
        y, x = (CELL_M * (np.indices((SIDE, SIDE)) - HALF_CELLS) + self._offset_m(pose)[::-1, None, None]).astype("f4")
        sector = np.floor((np.arctan2(y, x) - (pose[2] - math.pi)) * (len(free_m) / math.tau)).astype(np.intp)
        sector %= len(free_m)
        away_m, own_m = np.hypot(x, y), min(self._outline)
        # What farther views have shown nearer than the obstacle of a sector was the noise of their ranges.
        self._states[
            (away_m < ranges_m[sector] - CELL_M) & (self._states == OCCUPIED) & np.isfinite(ranges_m)[sector]
        ] = UNKNOWN
        self._states[away_m <= np.maximum(free_m, own_m)[sector]] = FREE
        # 2. Obstacles, and near ends of the floor.
        ends_m, edges_m = ranges_m.copy(), sector_edges_m(self._outline, len(free_m))
        for k, end_m, _ in unknown_ends(ranges_m.tolist(), free_m.tolist(), self._stop_m):
            if end_m < NEAR_M:
                ends_m[k] = max(end_m, edges_m[k])
        for each in (ranges_m, ends_m):
            at = np.flatnonzero(np.isfinite(each))
            angles = pose[2] - math.pi + (at + 0.5) * (math.tau / len(each))
            points = pose[:2] + each[at, None] * np.column_stack([np.cos(angles), np.sin(angles)])
            self._states[cells_of(points, self.corner(pose))] = OCCUPIED

    def states(self, pose: Array) -> Cells:
        """Return the states (SIDE, SIDE) of the cells about a pose, whose first one begins at `corner`."""
        self._follow(pose[:2])
        return self._states

    def closed(self, pose: Array, *, at_unknown: bool) -> Array:
        """Return the places (N, 2) in odom of cells that are OCCUPIED; at_unknown: or next to a FREE one UNKNOWN."""
        states = self.states(pose)
        is_closed = states == OCCUPIED
        if at_unknown:
            is_closed |= (states == UNKNOWN) & (cv2.dilate((states == FREE).view(np.uint8), np.ones((3, 3))) > 0)
        rows, columns = np.nonzero(is_closed)
        return np.asarray(self.corner(pose) + CELL_M * np.column_stack([columns, rows]))

    @staticmethod
    def corner(pose: Array) -> Array:
        """Return the middle (2,) of the first cell of a map about a pose."""
        return np.asarray(CELL_M * (np.round(pose[:2] / CELL_M) - HALF_CELLS))

    def _offset_m(self, pose: Array) -> Array:
        """Return the place of the middle of the map's cell of the base, from the base."""
        return np.asarray(self.corner(pose) + CELL_M * HALF_CELLS - pose[:2])

    def _follow(self, place_m: Array) -> None:
        """Move the cells along with the base; those that come into the map are unknown."""
        cell = np.round(place_m / CELL_M).astype(np.int64)
        x, y = np.clip(cell - (cell if self._cell is None else self._cell), -SIDE, SIDE).tolist()
        self._cell = cell
        if x or y:
            moved = np.full((SIDE, SIDE), UNKNOWN, np.uint8)
            to_y, to_x = (slice(max(-by, 0), SIDE - max(by, 0)) for by in (y, x))
            of_y, of_x = (slice(max(by, 0), SIDE - max(-by, 0)) for by in (y, x))
            moved[to_y, to_x] = self._states[of_y, of_x]
            self._states = moved


def cells_of(points: Array, corner: Array) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Return rows and columns of the points (N, 2) that lie in a map with this corner."""
    columns, rows = ((points - corner) / CELL_M).round().astype(np.intp).T
    inside = (columns >= 0) & (columns < SIDE) & (rows >= 0) & (rows < SIDE)
    return rows[inside], columns[inside]
