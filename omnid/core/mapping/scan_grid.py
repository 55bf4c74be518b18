"""Occupancy grid of range scans at poses: obstacles, and the floor between the robot and them (ray casting).

The scans are those of keyframes. A loop that closes moves the keyframes, and the grid is then drawn again.
That nothing was measured up to a range does not make a cell free, as nothing low or thin is measured: free are the
cells whose floor was seen (core/obstacles).
Log odds with limits: Elfes 1989, "Using occupancy grids for mobile robot perception and navigation"; the limits, by
which later views clear what has gone: Hornung et al. 2013, "OctoMap", section 3.4.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Final

import cv2
import numpy as np
from numpy.typing import NDArray

from omnid.core.mapping.range_scan import SURFACE_RATIO, azimuths

Array = NDArray[np.float64]
Ranges = NDArray[np.float32]

UNKNOWN, FREE, OCCUPIED = -1, 0, 100  # exact: the values of nav_msgs/msg/OccupancyGrid of ROS
# Bounds of the grid of a file and of a live one: 140 and 50 m square at cells of 0.05 m, of two bytes each.
MAX_CELLS: Final = 8_000_000
MAX_LIVE_CELLS: Final = 1_000_000
# Log odds are stored in tenths, so that a cell is one byte. A scan adds HIT to a cell with an obstacle (odds of 2.5 to
# 1) and subtracts MISS from a cell in front of it (1.5 to 1); by trial on development seeds.
HIT, MISS = 9, 4
# A cell stays within these, so that nine free views clear a wall that was seen often.
LIMITS: Final = (-5 * MISS, 4 * HIT - 1)
# A cell is occupied from two hits on and free from two misses on, because a single view may be a false match.
OCCUPIED_FROM, FREE_UNTIL = 2 * HIT - MISS, -2 * MISS
# From this far on a cell is free only where a view has seen through the whole of it, so that what is narrower than a
# cell and shows no range, as a plain pole, is unknown; nearer is the base itself. By trial on a development seed.
WHOLE_M: Final = 0.5
# Factor [1/m] of the squared range by which the free space ends before an obstacle, as the noise of stereo grows so.
SHORTER: Final = 0.02
SHIFT: Final = 4  # fractional bits of the polygons' corners: a sixteenth of a cell is enough
# Usual range of a wall. The area has this margin, so that it need not grow with each scan, and the grid is drawn again
# when a keyframe has moved by half a cell, or a wall at this distance by its turn.
WALL_M: Final = 5.0


@dataclass(frozen=True, slots=True)
class Grid:
    """Cells (H, W) int8, row 0 at the lowest y, column 0 at the lowest x; corner: x, y of cell (0, 0), m."""

    cells: NDArray[np.int8]
    cell_m: float
    corner: tuple[float, float]


@dataclass(frozen=True, slots=True, eq=False)
class KeyframeScans:
    """Range scans of keyframes by their ids in the order of addition, and the poses (K, 4, 4) of their frames."""

    scans: Mapping[int, NDArray[np.float16]]  # (360,) each, see range_scan.py
    free_m: Mapping[int, NDArray[np.float16]]  # (360,) each, up to which floor was seen, see FreeRanges
    T_map_rect: Array


class KeyframeGrid:
    """The grid; new scans are drawn into it, the oldest first, and all again where a keyframe has moved or left."""

    def __init__(self, cell_m: float, max_cells: int = MAX_LIVE_CELLS) -> None:
        """max_cells: the size of a cell is doubled until they suffice."""
        self._wanted_m, self._max_cells = cell_m, max_cells
        self._drawn: dict[int, Array] = {}  # x, y [m], yaw [rad] of the keyframes in it
        self._area, self._cell_m = np.array([[np.inf] * 2, [-np.inf] * 2]), cell_m  # lowest and highest x, y [m]

    def draw(self, keyframes: KeyframeScans, T_base_rect: Array) -> Grid:
        """Return the known part of the grid, in the axes of the base at the start of the map."""
        poses = T_base_rect @ keyframes.T_map_rect.reshape(-1, 4, 4)
        planar = np.column_stack([poses[:, :2, 3], np.arctan2(poses[:, 1, 0], poses[:, 0, 0])])
        now = dict(zip(keyframes.scans, planar, strict=True))
        # 1. The area that scans reach; all is drawn again where it has grown, or a keyframe is elsewhere or has left.
        reach = np.array([[np.max(scan, where=np.isfinite(scan), initial=0)] for scan in keyframes.scans.values()])
        near = np.vstack([planar[:, :2] - reach, planar[:, :2] + reach]) if len(planar) else np.zeros((1, 2))
        needed = np.array([near.min(axis=0), near.max(axis=0)])
        fits = (needed[0] >= self._area[0]).all() and (needed[1] <= self._area[1]).all()
        moved = [np.abs((before - now.get(id, np.inf)) * [1, 1, WALL_M]).max() for id, before in self._drawn.items()]
        if not fits or max(moved, default=0.0) > self._cell_m / 2:
            self._clear(needed + np.array([[-WALL_M], [WALL_M]]))
        # 2. The new scans, the oldest first, because later ones count more.
        for id, pose in now.items():
            if id not in self._drawn:
                scan, free_m = (of[id].astype(np.float32) for of in (keyframes.scans, keyframes.free_m))
                self._add(scan, free_m, pose)
                self._drawn[id] = pose
        return self._known_part()

    def _clear(self, area: Array) -> None:
        """Begin an empty grid of an area (2, 2) [m]."""
        self._area, self._cell_m, self._drawn = area, self._wanted_m, {}
        while math.prod(np.floor(area[1] / self._cell_m) - np.floor(area[0] / self._cell_m) + 1) > self._max_cells:
            self._cell_m *= 2
        self._first = np.floor(area[0] / self._cell_m)
        width, height = (np.floor(area[1] / self._cell_m) - self._first + 1).astype(int)
        # Of obstacles; of the floor, by the views that have seen it.
        self._odds, self._floor_odds = np.zeros((2, height, width), np.int8)

    def _add(self, scan: Ranges, free_m: Ranges, pose: Array) -> None:
        """Add a scan (SECTORS,) at x, y, yaw, and up to where floor was seen there, free_m (SECTORS,)."""
        # 1. The ends of the ranges in cells, and the part of the grid in which they lie.
        known, angles = np.isfinite(scan), azimuths() + pose[2]
        ranges = np.where(known, scan, np.inf)
        direction = np.column_stack([np.cos(angles), np.sin(angles)]) / self._cell_m
        centre = pose[:2] / self._cell_m - self._first
        ends = centre + np.where(known, scan, 0.0)[:, None] * direction
        corners = np.vstack([ends, centre])
        left, top = np.maximum(np.floor(corners.min(axis=0)) - 1, 0).astype(int)
        right, bottom = np.ceil(corners.max(axis=0)).astype(int) + 2
        part = slice(top, bottom), slice(left, right)
        shape, centre, ends = self._odds[part].shape, centre - [left, top], ends - [left, top]
        # 2. The free space ends before the nearest range of two neighbours on each side, as an edge may be measured so
        #    far off; a sector without a range has none.
        neighbours = [np.roll(ranges, shift) for shift in (-2, -1, 0, 1, 2)]
        nearest = np.where(known, np.min(neighbours, axis=0), 0.0)
        through_m = np.maximum(nearest - self._cell_m - SHORTER * nearest**2, 0.0)
        floor_m = np.minimum(through_m, np.maximum(free_m, 0.0))
        # 3. The obstacles, and the sum of both; a cell with an obstacle is not free.
        hit = _hits(shape, scan, ends)
        for odds, range_m in ((self._odds[part], through_m), (self._floor_odds[part], floor_m)):
            free = _polygon(shape, centre, centre + range_m[:, None] * direction, WHOLE_M / self._cell_m)
            np.clip(odds + np.where(hit, HIT, -MISS * free), *LIMITS, out=odds, casting="unsafe")

    def _known_part(self) -> Grid:
        """Return the part with known cells; a cell is free where its floor was seen.

        It is not next to an occupied one, as an obstacle is known to a cell only.
        """
        is_occupied = self._odds >= OCCUPIED_FROM
        near = cv2.dilate(is_occupied.astype(np.uint8), np.ones((3, 3), np.uint8)) > 0
        is_free = (self._floor_odds <= FREE_UNTIL) & ~near
        cells = np.where(is_occupied, OCCUPIED, np.where(is_free, FREE, UNKNOWN)).astype(np.int8)
        rows, columns = np.nonzero(cells != UNKNOWN)
        top, left = (int(rows.min()), int(columns.min())) if len(rows) else (0, 0)
        if len(rows):
            cells = cells[top : rows.max() + 1, left : columns.max() + 1]
        x, y = ((self._first + np.array([left, top])) * self._cell_m).tolist()
        return Grid(cells, self._cell_m, (x, y))


def _fixed_point(cells: Array) -> NDArray[np.int32]:
    """Return places [cells] as OpenCV draws them, which has integers at the middles of cells."""
    return np.asarray(np.rint((cells - 0.5) * 2**SHIFT), np.int32)


def _polygon(shape: tuple[int, ...], centre: Array, ends: Array, whole: float) -> NDArray[np.int8]:
    """Return the cells that a view from `centre` (2,) has seen through, up to `ends` (SECTORS, 2): 1, else 0.

    The cells are whole ones from the distance `whole` on: of those below the outline a part was not seen through.
    """
    cells, outline = np.zeros((2, *shape), np.uint8)
    cv2.fillPoly(cells, [_fixed_point(ends)], 1, shift=SHIFT)
    cv2.polylines(outline, [_fixed_point(ends)], True, 1, shift=SHIFT)
    cv2.circle(outline, _fixed_point(centre).tolist(), round(whole * 2**SHIFT), 0, cv2.FILLED, shift=SHIFT)
    return np.asarray((cells & ~outline & 1).view(np.int8))


def _hits(shape: tuple[int, ...], scan: Ranges, ends: Array) -> NDArray[np.bool_]:
    """Return the obstacles of a scan: its ends (SECTORS, 2) [cells], and the lines between those of one surface."""
    hit, following, cells = np.zeros(shape, np.uint8), np.roll(scan, -1), np.floor(ends).astype(np.int32)
    with np.errstate(invalid="ignore"):
        is_surface = np.maximum(scan, following) <= SURFACE_RATIO * np.minimum(scan, following)  # False for NaN
    cv2.polylines(hit, list(np.stack([cells, np.roll(cells, -1, axis=0)], axis=1)[is_surface]), False, 1)
    hit[tuple(cells[np.isfinite(scan)].T[::-1])] = 1
    return hit.view(bool)
