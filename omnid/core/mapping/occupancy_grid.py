"""The map as a grid of cells for planners: what stands in the way, where the robot has been, and what nobody knows."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Final

import cv2
import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.floating]

UNKNOWN, FREE, TAKEN = -1, 0, 100  # of nav_msgs/msg/OccupancyGrid; between: how sure it is that something is there
MOST_CELLS: Final = 1_000_000
BLOCK: Final = 4096  # points
_FARTHEST_M: Final = 1e5


@dataclass(frozen=True, slots=True)
class Grid:
    """Cells (H, W) int8, row 0 at the lowest y, column 0 at the lowest x; corner: of cell (0, 0), x and y in metres."""

    cells: NDArray[np.int8]
    cell_m: float
    corner: tuple[float, float]


def occupancy(points: Array, confidence: Array, path_xy: Array, heights_m: tuple[float, float], cell_m: float) -> Grid:
    """A grid over points (N, 3) between two heights [m] with confidence (N,) 0 to 1, and a path (M, 2) [m].

    A cell is as taken as the surest of its points is, and free where the path leads through and nothing stands:
    elsewhere nobody has been, and what lies behind a wall looks like what lies before it. Cells grow by powers of two
    until there are at most MOST_CELLS of them. The points are taken block by block: a map is large.
    """
    stands = _near(points) & (points[:, 2] >= heights_m[0]) & (points[:, 2] <= heights_m[1])
    path = path_xy[_near(path_xy)]
    grid = _empty(_bounds(points, stands), _bounds(path, np.ones(len(path), bool)), cell_m)
    _walk(grid, path)
    flat = grid.cells.reshape(-1)
    for start in range(0, len(points), BLOCK):
        kept = np.flatnonzero(stands[start : start + BLOCK]) + start
        column, row = _cells(grid, points[kept, :2]).T
        taken = np.clip(np.ceil(TAKEN * confidence[kept]), 1, TAKEN).astype(np.int8)
        np.maximum.at(flat, row * grid.cells.shape[1] + column, taken)
    return grid


def _near(points: Array) -> NDArray[np.bool_]:
    """Which of points (N, 2 or more) have a place on a map; column by column, for numpy is slow along short rows."""
    x, y = points[:, 0], points[:, 1]
    return np.asarray((np.abs(x) < _FARTHEST_M) & (np.abs(y) < _FARTHEST_M))  # a NaN is not


def _bounds(points: Array, which: NDArray[np.bool_]) -> Array:
    """Lowest and highest x and y (2, 2) of some points (N, 2 or more); infinite, the wrong way round, of none."""
    columns = points[:, 0], points[:, 1]
    return np.array([[np.min(column, where=which, initial=np.inf) for column in columns],
                     [np.max(column, where=which, initial=-np.inf) for column in columns]])


def _empty(points: Array, path: Array, cell_m: float) -> Grid:
    """Unknown cells that hold both of these bounds (2, 2), their borders at whole multiples of the cell."""
    low, high = np.minimum(points[0], path[0]), np.maximum(points[1], path[1])
    if (low > high).any():
        low = high = np.zeros(2)
    while math.prod(np.floor(high / cell_m) - np.floor(low / cell_m) + 1) > MOST_CELLS:
        cell_m *= 2
    first = np.floor(low / cell_m)
    width, height = (np.floor(high / cell_m) - first + 1).astype(int)
    x, y = (first * cell_m).tolist()
    return Grid(np.full((height, width), UNKNOWN, np.int8), cell_m, (x, y))


def _cells(grid: Grid, xy: Array) -> NDArray[np.int64]:
    """Column and row (N, 2) of points (N, 2)."""
    found = np.floor(xy / grid.cell_m) - np.rint(np.array(grid.corner) / grid.cell_m)
    return np.asarray(found, np.int64)


def _walk(grid: Grid, path: Array) -> None:
    """Frees the cells that the path leads through."""
    seen, steps = np.zeros(grid.cells.shape, np.uint8), _cells(grid, path)
    cv2.polylines(seen, [steps.astype(np.int32).reshape(-1, 1, 2)], False, 1)
    seen[steps[:, 1], steps[:, 0]] = 1  # a single step is no line
    grid.cells[seen > 0] = FREE
