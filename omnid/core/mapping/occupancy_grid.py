"""Occupancy grid of the map for planners: occupied, free and unknown cells."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

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
