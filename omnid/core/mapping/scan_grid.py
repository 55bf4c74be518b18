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

from omnid.core.mapping.range_scan import SECTORS, SURFACE_RATIO, FreeRanges, RangeScan, azimuths

UNKNOWN, FREE, OCCUPIED = -1, 0, 100  # exact: the values of nav_msgs/msg/OccupancyGrid of ROS


@dataclass(frozen=True, slots=True)
class Grid:
    """Cells (H, W) int8, row 0 at the lowest y, column 0 at the lowest x; corner: x, y of cell (0, 0), m."""

    cells: NDArray[np.int8]
    cell_m: float
    corner: tuple[float, float]


def known_part(grid: Grid) -> Grid:
    """Return the part of a grid that holds its known cells; the whole grid without any."""
    rows, columns = np.nonzero(grid.cells != UNKNOWN)
    if not len(rows):
        return grid
    low, high = (int(rows.min()), int(columns.min())), (int(rows.max()) + 1, int(columns.max()) + 1)
    corner = grid.corner[0] + low[1] * grid.cell_m, grid.corner[1] + low[0] * grid.cell_m
    return Grid(grid.cells[low[0] : high[0], low[1] : high[1]], grid.cell_m, corner)


Array = NDArray[np.float64]
Cells = NDArray[np.int8]

# Three bytes for each cell are 24 MB, so that the grid fits a small computer; 140 m by 140 m at cells of 0.05 m.
MAX_CELLS: Final = 8_000_000
# Log odds are stored in tenths, so that a cell is one byte. A scan adds HIT to a cell with an obstacle (odds of 2.5 to
# 1) and subtracts MISS from a cell in front of it (1.5 to 1); by trial on development seeds.
HIT: Final = 9
MISS: Final = 4
# Tenths of log odds at which a cell stays, so that nine free views clear a wall that was seen often.
LIMITS: Final = (-20, 35)
# A cell is occupied from two hits on, because a single one may be a false match ...
OCCUPIED_FROM: Final = 14
# ... and free from two misses on, because a false match may let a single view pass through a wall.
FREE_UNTIL: Final = -8
# From this far on a cell is free only where a view has seen through the whole of it, so that what is narrower than a
# cell and shows no range, as a plain pole, is unknown; nearer is the base itself. By trial on a development seed.
WHOLE_M: Final = 0.5
# Factor [1/m] of the squared range: the free space ends by this much before the obstacle, because the noise of stereo
# grows like that.
SHORTER: Final = 0.02
# Sectors to each side whose nearest range ends the free space, because an edge may be measured that far off.
EDGE_SECTORS: Final = 2
# Factor [1/m] of the squared range: so much farther may stand what is narrow and ends the free floor. It is four
# disparities of the usual rig; with 0.12 and 0.18, by trial on development seeds, as many cells of poles were free.
NARROW: Final = 0.14
# What is narrow and ends the floor nearer than this may stand anywhere before it, because nearer floor may be out of
# view, up to 0.8 to 1 m with the usual rig. Without, 4 of 89 cells of poles were free on development seeds, with it 2.
TOO_NEAR_M: Final = 1.0
# From farther away a view through a cell is not sure that nothing narrow stands there, because one view shows 64 % of
# plain poles of 3 to 4.5 cm from 1.3 to 1.7 m, 21 % from 1.7 to 2.6 m (development seed 1).
SURE_M: Final = 1.5
# Limits of its log odds in tenths, so that after two near views through a cell three that end there make it unknown.
NARROW_LIMITS: Final = (-2 * MISS, 3 * MISS)
# Fractional bits of the polygons' corners: a sixteenth of a cell is enough.
SHIFT: Final = 4


class ScanGrid:
    """Log odds of cells, drawn scan by scan; the oldest first, because later ones count more."""

    def __init__(self, low: Array, high: Array, cell_m: float, max_cells: int) -> None:
        """low, high: corners (2,) [m] of the area. The size of a cell is doubled until max_cells suffice."""
        while math.prod(np.floor(high / cell_m) - np.floor(low / cell_m) + 1) > max_cells:
            cell_m *= 2
        self._cell_m = cell_m
        self._first = np.floor(low / cell_m)
        width, height = (np.floor(high / cell_m) - self._first + 1).astype(int)
        self._odds = np.zeros((height, width), np.int8)
        self._floor_odds = np.zeros((height, width), np.int8)  # the same, by the views that have seen the floor
        self._narrow_odds = np.zeros((height, width), np.int8)  # of what is narrow, by views that end, or pass it

    def add(self, scan: RangeScan, free_m: FreeRanges, x_m: float, y_m: float, yaw_rad: float) -> None:
        """Add a scan (SECTORS,) whose frame has this pose in the map, and up to where floor was seen there.

        free_m: negative where something narrow hides the floor from there on.
        """
        # 1. The ends of the ranges, and the part of the grid in which they lie.
        known = np.isfinite(scan)
        angle = azimuths() + yaw_rad
        direction = np.column_stack([np.cos(angle), np.sin(angle)]) / self._cell_m
        centre = np.array([x_m, y_m]) / self._cell_m - self._first
        ends = centre + np.where(known, scan, 0.0)[:, None] * direction
        window = self._window(ends, centre)
        if window is None:
            return
        left, top, right, bottom = window
        part = slice(top, bottom), slice(left, right)
        # 2. The free space ends before the nearest range of some neighbours; a sector without a range has none.
        ranges = np.where(known, scan, np.inf)
        neighbours = [np.roll(ranges, shift) for shift in range(-EDGE_SECTORS, EDGE_SECTORS + 1)]
        nearest = np.where(known, np.min(neighbours, axis=0), 0.0)
        seen_through = np.maximum(nearest - self._cell_m - SHORTER * nearest**2, 0.0)
        # 3. The obstacles, and the sum of both; a cell with an obstacle is not free.
        hit = np.zeros(self._odds[part].shape, np.uint8)
        _draw_hits(hit, scan, ends - [left, top])
        middle, near = centre - [left, top], WHOLE_M / self._cell_m
        floor_m = np.minimum(seen_through, np.abs(free_m))
        for odds, range_m in ((self._odds[part], seen_through), (self._floor_odds[part], floor_m)):
            free = _free(odds.shape, middle, middle + range_m[:, None] * direction, near)
            change = np.where(hit > 0, HIT, -MISS * free.astype(np.int8)).astype(np.int8)
            np.clip(odds + change, *LIMITS, out=odds)
        # 4. What is narrow stands in one of the cells where the floor ends, and in none that is passed near by.
        odds, passed_m = self._narrow_odds[part], np.minimum(floor_m, SURE_M)
        passed = _free(odds.shape, middle, middle + passed_m[:, None] * direction, near)
        ended = _narrow(odds.shape, middle, free_m, angle, self._cell_m)
        change = MISS * np.where(ended > 0, ended, -passed.astype(np.int8))
        np.clip(odds + change, *NARROW_LIMITS, out=odds)

    def grid(self) -> Grid:
        """Return the occupied, free and unknown cells; a cell is free where its floor was seen.

        It is not where the views that something narrow ends are two more than those that pass it near by.
        """
        odds = self._floor_odds.copy()
        odds[(self._narrow_odds > MISS) & (odds < 0)] = 0
        # A cell next to an occupied one is never free, as an obstacle is known to a cell only.
        cells = np.full(self._odds.shape, UNKNOWN, np.int8)
        is_occupied = self._odds >= OCCUPIED_FROM
        near = cv2.dilate(is_occupied.astype(np.uint8), np.ones((3, 3), np.uint8)) > 0
        cells[(odds <= FREE_UNTIL) & ~near] = FREE
        cells[is_occupied] = OCCUPIED
        x, y = (self._first * self._cell_m).tolist()
        return Grid(cells, self._cell_m, (x, y))

    def _window(self, ends: Array, centre: Array) -> tuple[int, int, int, int] | None:
        """Return left, top, right and bottom of the cells around ends (SECTORS, 2), None where none lies inside."""
        corners = np.vstack([ends, centre])
        low = np.clip(np.floor(corners.min(axis=0)) - 1, 0, None).astype(int)
        high = np.minimum(np.ceil(corners.max(axis=0)) + 2, self._odds.shape[::-1]).astype(int)
        return (int(low[0]), int(low[1]), int(high[0]), int(high[1])) if (low < high).all() else None


def reach_m(scan: NDArray[np.floating]) -> float:
    """Return the largest known range of a scan [m], 0 without one."""
    return float(np.max(scan, where=np.isfinite(scan), initial=0.0))


def _free(shape: tuple[int, ...], centre: Array, ends: Array, near: float) -> NDArray[np.uint8]:
    """Return the cells that a view from `centre` (2,) has seen through, up to `ends` (SECTORS, 2): 1, else 0.

    The cells are whole ones from `near` on; all lengths in cells. OpenCV has integers at the middles of cells.
    """
    corners, middle = (np.rint((at - 0.5) * 2**SHIFT).astype(np.int32) for at in (ends, centre))
    free, outline = np.zeros(shape, np.uint8), np.zeros(shape, np.uint8)
    cv2.fillPoly(free, [corners], 1, shift=SHIFT)
    # Of the cells below the polygon's outline, a part was not seen through.
    cv2.polylines(outline, [corners], True, 1, shift=SHIFT)
    cv2.circle(outline, middle.tolist(), round(near * 2**SHIFT), 0, cv2.FILLED, shift=SHIFT)
    return np.where(outline, np.uint8(0), free)


def _narrow(
    shape: tuple[int, ...], centre: Array, free_m: FreeRanges, angles: Array, cell_m: float
) -> NDArray[np.int8]:
    """Return the cells in which something narrow may stand that ends a view from `centre` (2,) [cells]: 1, else 0.

    free_m (SECTORS,): negative where it does, along angles (SECTORS,).
    """
    cells, half = np.zeros(shape, np.uint8), math.pi / SECTORS
    for sector in np.flatnonzero(free_m < 0):
        near_m = -float(free_m[sector])
        far_m, sides = near_m + NARROW * near_m**2, np.array([-half, half, half, -half])
        near_m = near_m if near_m > TOO_NEAR_M else 0.0
        ranges = np.array([near_m, near_m, far_m, far_m]) / cell_m
        at = centre + ranges[:, None] * np.column_stack(
            [np.cos(angles[sector] + sides), np.sin(angles[sector] + sides)]
        )
        cv2.fillConvexPoly(cells, np.rint((at - 0.5) * 2**SHIFT).astype(np.int32), 1, shift=SHIFT)
    return cells.view(np.int8)


def _draw_hits(hit: NDArray[np.uint8], scan: RangeScan, ends: Array) -> None:
    """Draw the obstacles of a scan: its ends (SECTORS, 2) [cells], and the lines between those of one surface."""
    following = np.roll(scan, -1)
    with np.errstate(invalid="ignore"):
        is_surface = np.maximum(scan, following) <= SURFACE_RATIO * np.minimum(scan, following)  # False for NaN
    cells = np.floor(ends).astype(np.int32)
    lines = np.stack([cells, np.roll(cells, -1, axis=0)], axis=1)[is_surface]
    cv2.polylines(hit, list(lines), False, 1)
    inside = np.isfinite(scan) & ((cells >= 0) & (cells < hit.shape[::-1])).all(axis=1)
    hit[cells[inside, 1], cells[inside, 0]] = 1


MAX_LIVE_CELLS: Final = 1_000_000  # 50 m by 50 m at cells of 0.05 m, so that a message has 1 MB.
MARGIN_M: Final = 5.0  # around the area of the scans, so that it need not grow with each of them
# The grid is drawn again when a keyframe has moved farther than this, because less than half a cell changes no cell;
# 0.3 degrees are half a cell at 5 m.
MOVED_CELLS, MOVED_RAD = 0.5, math.radians(0.3)


@dataclass(frozen=True, slots=True, eq=False)
class KeyframeScans:
    """Range scans of keyframes by their ids in the order of addition, and the poses (K, 4, 4) of their frames."""

    scans: Mapping[int, NDArray[np.float16]]  # (360,) each, see range_scan.py
    free_m: Mapping[int, NDArray[np.float16]]  # (360,) each, up to which floor was seen, see FreeRanges
    T_map_rect: Array
    loops: tuple[tuple[int, int], ...] = ()  # ids of the keyframes between which places were recognised


class KeyframeGrid:
    """The grid; new scans are drawn into it, the oldest first, and all again where a keyframe has moved or left."""

    def __init__(self, cell_m: float, max_cells: int = MAX_LIVE_CELLS) -> None:
        """max_cells: the size of a cell is doubled until they suffice."""
        self._cell_m, self._max_cells = cell_m, max_cells
        self._drawn: dict[int, tuple[float, float, float]] = {}  # x, y [m], yaw [rad] of the keyframes in it
        self._area = np.array([[np.inf, np.inf], [-np.inf, -np.inf]])  # lowest and highest x, y [m]
        self._grid: ScanGrid | None = None
        self.redrawn = 0

    def draw(self, keyframes: KeyframeScans, T_base_rect: Array) -> Grid:
        """Return the known part of the grid, in the axes of the base at the start of the map."""
        poses = T_base_rect @ keyframes.T_map_rect.reshape(-1, 4, 4)
        planar = {
            id: (float(T[0, 3]), float(T[1, 3]), math.atan2(T[1, 0], T[0, 0]))
            for id, T in zip(keyframes.scans, poses, strict=True)
        }
        needed = _area(keyframes, planar)
        fits = bool((needed[0] >= self._area[0]).all() and (needed[1] <= self._area[1]).all())
        if self._grid is None or not fits or any(self._has_moved(id, planar.get(id)) for id in self._drawn):
            self._area = needed + np.array([[-MARGIN_M], [MARGIN_M]])
            self._grid, self._drawn = ScanGrid(self._area[0], self._area[1], self._cell_m, self._max_cells), {}
            self.redrawn += 1
        for id, (x, y, yaw) in planar.items():
            if id not in self._drawn:
                scan, free_m = (of[id].astype(np.float32) for of in (keyframes.scans, keyframes.free_m))
                self._grid.add(scan, free_m, x, y, yaw)
                self._drawn[id] = x, y, yaw
        return known_part(self._grid.grid())

    def _has_moved(self, id: int, now: tuple[float, float, float] | None) -> bool:
        """True if a keyframe that was drawn has left, or is elsewhere now."""
        if now is None:
            return True
        x, y, yaw = self._drawn[id]
        return (
            math.hypot(now[0] - x, now[1] - y) > MOVED_CELLS * self._cell_m
            or abs(math.remainder(now[2] - yaw, 2 * math.pi)) > MOVED_RAD
        )


def _area(keyframes: KeyframeScans, planar: Mapping[int, tuple[float, float, float]]) -> Array:
    """Return the lowest and highest x, y (2, 2) [m] that scans reach; those of the origin without scans."""
    if not planar:
        return np.zeros((2, 2))
    xy = np.array([pose[:2] for pose in planar.values()])
    reach = np.array([[reach_m(scan)] for scan in keyframes.scans.values()])
    return np.array([(xy - reach).min(axis=0), (xy + reach).max(axis=0)])
