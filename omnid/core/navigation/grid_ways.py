"""Ways in a small grid about the base: distances to points, and the wave front (NF1) of the way left to a goal."""

from __future__ import annotations

import math
from typing import Final, NamedTuple

import cv2
import numpy as np
import scipy
from numpy.typing import NDArray

Array = NDArray[np.float64]


# Set by trial on development seeds, where a line gives no other reason.
# By trial on development seeds.
CELL_M: Final = 0.05
HALF_CELLS: Final = 64  # Half the side of the grid about the base: 3.2 m to each side.
# Way left where no way leads to the path; so that it is never chosen: longer than any way in the grid.
FAR_M: Final = 1e3


def to_cells(points: Array, corner: Array) -> NDArray[np.intp]:
    """Return columns and rows (..., 2) of points (..., 2), those beyond the grid at its border."""
    return np.clip(((points - corner) / CELL_M).round(), 0, 2 * HALF_CELLS).astype(np.intp)


def grid_distances(points: Array, corner: Array) -> Array:
    """Return the distance of each cell to the nearest point [m]."""
    size = 2 * HALF_CELLS + 1
    inside = ((points >= corner) & (points <= corner + 2 * HALF_CELLS * CELL_M)).all(axis=1)
    grid = np.ones((size, size), np.uint8)
    cells = to_cells(points[inside], corner)
    grid[cells[:, 1], cells[:, 0]] = 0
    if not len(cells):
        return np.full((size, size), FAR_M)
    return np.asarray(cv2.distanceTransform(grid, cv2.DIST_L2, cv2.DIST_MASK_PRECISE) * CELL_M, np.float64)


class Neighbours(NamedTuple):
    """Edges between neighbouring cells of the grid, in the order of their first cell."""

    first: NDArray[np.int32]
    second: NDArray[np.int32]
    length_m: Array


def neighbours() -> Neighbours:
    """Return the edges to the eight cells around each cell."""
    size = 2 * HALF_CELLS + 1
    rows, columns, steps = np.meshgrid(np.arange(size), np.arange(size), np.arange(8), indexing="ij")
    dy = np.array([-1, -1, -1, 0, 0, 1, 1, 1])[steps]
    dx = np.array([-1, 0, 1, -1, 1, -1, 0, 1])[steps]
    inside = (rows + dy >= 0) & (rows + dy < size) & (columns + dx >= 0) & (columns + dx < size)
    first = (rows * size + columns)[inside]
    second = ((rows + dy) * size + columns + dx)[inside]
    return Neighbours(first.astype(np.int32), second.astype(np.int32), CELL_M * np.hypot(dx, dy)[inside])


def wave_front(edges: Neighbours, is_free: NDArray[np.bool_], weight: Array, goal: NDArray[np.intp]) -> Array | None:
    """Return the weighted way from each free cell to the goal [m], FAR_M without one; None if the goal is not free."""
    column, row = int(goal[0]), int(goal[1])
    if not is_free[row, column]:
        return None
    free = is_free.ravel()
    usable = free[edges.first] & free[edges.second]
    counts = np.bincount(edges.first[usable], minlength=free.size)
    lengths = edges.length_m[usable] * weight.ravel()[edges.first[usable]]
    graph = scipy.sparse.csr_matrix(
        (lengths, edges.second[usable], np.concatenate([[0], np.cumsum(counts)])), shape=(free.size, free.size)
    )
    found = scipy.sparse.csgraph.dijkstra(graph, indices=row * len(is_free) + column)
    return np.asarray(np.where(np.isfinite(found), found, FAR_M).reshape(is_free.shape))


def descent(left_m: Array, rows: NDArray[np.intp], columns: NDArray[np.intp]) -> Array:
    """Return the direction [rad] in which the way left falls most, over some cells."""
    best, direction = np.full(len(rows), np.inf), np.zeros(len(rows))
    reach, limit = 4, len(left_m) - 1
    for k in range(16):
        angle = 2 * math.pi * k / 16
        r = np.clip(rows + round(reach * math.sin(angle)), 0, limit)
        c = np.clip(columns + round(reach * math.cos(angle)), 0, limit)
        lower = left_m[r, c] < best
        best, direction = np.where(lower, left_m[r, c], best), np.where(lower, angle, direction)
    return direction
