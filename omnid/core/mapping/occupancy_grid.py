"""Occupancy grid of the map for planners: occupied, free and unknown cells."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Final

import cv2
import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.floating]

UNKNOWN, FREE, OCCUPIED = -1, 0, 100  # of nav_msgs/msg/OccupancyGrid; between the last two: probability, per cent
MAX_CELLS: Final = 1_000_000
BLOCK_POINTS: Final = 4096  # handled at a time, so that a large map needs little extra memory
_MAX_DISTANCE_M: Final = 1e5  # of a coordinate; points beyond are left out


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


def occupancy(points: Array, confidence: Array, path_xy: Array, heights_m: tuple[float, float], cell_m: float) -> Grid:
    """Return a grid over points (N, 3) between two heights [m] with confidence (N,) 0 to 1, and a path (M, 2) [m].

    The occupancy of a cell is the highest confidence of its points. Cells without points are free where the path
    crosses them and unknown elsewhere. Cells double in size until there are at most MAX_CELLS of them.
    """
    obstacle = _is_mappable(points) & (points[:, 2] >= heights_m[0]) & (points[:, 2] <= heights_m[1])
    path = path_xy[_is_mappable(path_xy)]
    grid = _empty(_bounds(points, obstacle), _bounds(path, np.ones(len(path), bool)), cell_m)
    _free_path(grid, path)
    flat = grid.cells.reshape(-1)
    for start in range(0, len(points), BLOCK_POINTS):
        kept = np.flatnonzero(obstacle[start : start + BLOCK_POINTS]) + start
        column, row = _cells(grid, points[kept, :2]).T
        occupied = np.clip(np.ceil(OCCUPIED * confidence[kept]), 1, OCCUPIED).astype(np.int8)
        np.maximum.at(flat, row * grid.cells.shape[1] + column, occupied)
    return grid


def _is_mappable(points: Array) -> NDArray[np.bool_]:
    """Return flags (N,) of the points (N, 2 or more) that are finite and near enough."""
    x, y = points[:, 0], points[:, 1]  # by columns: numpy is slow along short rows
    return np.asarray((np.abs(x) < _MAX_DISTANCE_M) & (np.abs(y) < _MAX_DISTANCE_M))  # False for NaN


def _bounds(points: Array, which: NDArray[np.bool_]) -> Array:
    """Return lowest and highest x and y (2, 2) of some points (N, 2 or more); inf and -inf without points."""
    columns = points[:, 0], points[:, 1]
    return np.array([[np.min(column, where=which, initial=np.inf) for column in columns],
                     [np.max(column, where=which, initial=-np.inf) for column in columns]])


def _empty(points: Array, path: Array, cell_m: float) -> Grid:
    """Return a grid of unknown cells over both bounds (2, 2), with borders at multiples of the cell size."""
    low, high = np.minimum(points[0], path[0]), np.maximum(points[1], path[1])
    if (low > high).any():
        low = high = np.zeros(2)
    while math.prod(np.floor(high / cell_m) - np.floor(low / cell_m) + 1) > MAX_CELLS:
        cell_m *= 2
    first = np.floor(low / cell_m)
    width, height = (np.floor(high / cell_m) - first + 1).astype(int)
    x, y = (first * cell_m).tolist()
    return Grid(np.full((height, width), UNKNOWN, np.int8), cell_m, (x, y))


def _cells(grid: Grid, xy: Array) -> NDArray[np.int64]:
    """Return column and row (N, 2) of points (N, 2)."""
    found = np.floor(xy / grid.cell_m) - np.rint(np.array(grid.corner) / grid.cell_m)
    return np.asarray(found, np.int64)


def _free_path(grid: Grid, path: Array) -> None:
    """Set the cells that the path crosses to free."""
    crossed, steps = np.zeros(grid.cells.shape, np.uint8), _cells(grid, path)
    cv2.polylines(crossed, [steps.astype(np.int32).reshape(-1, 1, 2)], False, 1)
    crossed[steps[:, 1], steps[:, 0]] = 1  # a single point draws no line
    grid.cells[crossed > 0] = FREE
