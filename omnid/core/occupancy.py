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
    until there are at most MOST_CELLS of them.
    """
    low_m, high_m = heights_m
    stands = _near(points) & (points[:, 2] >= low_m) & (points[:, 2] <= high_m)
    xy, path = points[stands, :2], path_xy[_near(path_xy)]
    grid = _empty(np.vstack([xy, path]), cell_m)
    _walk(grid, path)
    column, row = _cells(grid, xy).T
    taken = np.clip(np.ceil(TAKEN * confidence[stands]), 1, TAKEN).astype(np.int8)
    np.maximum.at(grid.cells.reshape(-1), row * grid.cells.shape[1] + column, taken)  # flat: several times as fast
    return grid


def _near(points: Array) -> NDArray[np.bool_]:
    """Which of points (N, 2 or more) have a place on a map; column by column, for numpy is slow along short rows."""
    x, y = points[:, 0], points[:, 1]
    return np.asarray((np.abs(x) < _FARTHEST_M) & (np.abs(y) < _FARTHEST_M))  # a NaN is not


def _empty(xy: Array, cell_m: float) -> Grid:
    """Unknown cells that hold all of these points, their borders at whole multiples of the cell."""
    columns = xy.T if len(xy) else np.zeros((2, 1))
    low, high = (np.array([bound(column) for column in columns], np.float64) for bound in (np.min, np.max))
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
