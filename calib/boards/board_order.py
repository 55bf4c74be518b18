"""The board in a grid of corners: the part of the right count, and which way round it is."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from calib.boards.board import Board
from calib.boards.corner_candidates import Grey, sample
from calib.boards.corner_grid import Grid
from calib.models.camera import Array

# A board may lack this part of its corners, if every one of its four borders shows so many of its own.
MIN_FILLED = 0.9
MIN_BORDER = 0.6
# A row beyond the board with so many of its corners there belongs to a larger board.
BEYOND = 0.7


def place(grid: Grid, board: Board) -> Array | None:
    """Corners (rows, columns, 2), NaN where hidden: what of the grid has the board's count and nothing beyond it."""
    return max(_windows(grid, board), key=lambda window: float(np.isfinite(window).mean()), default=None)


def as_array(grid: Grid) -> Array:
    """The grid as (rows, columns, 2) with a border of two NaN all around."""
    cells = np.array(list(grid))
    low, high = cells.min(axis=0) - 2, cells.max(axis=0) + 2
    corners = np.full((high[1] - low[1] + 1, high[0] - low[0] + 1, 2), np.nan)
    for (i, j), pixel in grid.items():
        corners[j - low[1], i - low[0]] = pixel
    return corners


def as_grid(corners: Array) -> Grid:
    """The known corners (rows, columns, 2) by (column, row)."""
    return {(int(i), int(j)): corners[j, i] for j, i in np.argwhere(np.isfinite(corners[..., 0]))}


def _windows(grid: Grid, board: Board) -> Iterator[Array]:
    """Every placing of the board, either way up, that is filled well and has no row beyond it."""
    for upright in (as_array(grid), _quarter(as_array(grid))):
        known = np.isfinite(upright[..., 0])
        for j in range(1, known.shape[0] - board.rows):
            for i in range(1, known.shape[1] - board.columns):
                around = known[j - 1:j + board.rows + 1, i - 1:i + board.columns + 1]
                if _stands_alone(around):
                    yield upright[j:j + board.rows, i:i + board.columns]


def _stands_alone(around: np.ndarray[tuple[int, ...], np.dtype[np.bool_]]) -> bool:
    inside = around[1:-1, 1:-1]
    borders = (inside[0], inside[-1], inside[:, 0], inside[:, -1])
    beyond = (around[0, 1:-1], around[-1, 1:-1], around[1:-1, 0], around[1:-1, -1])
    return bool(inside.mean() >= MIN_FILLED and min(border.mean() for border in borders) >= MIN_BORDER
                and max(row.mean() for row in beyond) < BEYOND)


def _quarter(corners: Array) -> Array:
    """The corners turned by a quarter, so that columns and rows change places and the turning sense is kept."""
    return np.rot90(corners, axes=(0, 1))


def largest_board(grid: Grid) -> tuple[int, int]:
    """Columns and rows of the largest full rectangle in a grid: what board there seems to be."""
    known = np.isfinite(as_array(grid)[..., 0])
    heights, best = np.zeros(known.shape[1], int), (0, 0)
    for row in known:
        heights = np.where(row, heights + 1, 0)
        for i in range(len(heights)):
            lowest = np.minimum.accumulate(heights[i:])
            width = int(np.argmax(lowest * np.arange(1, len(lowest) + 1))) + 1
            best = max(best, (width, int(lowest[width - 1])), key=lambda sides: sides[0] * sides[1])
    return best


def in_order(image: Grey, corners: Array, board: Board) -> Array:
    """Corners (rows, columns, 2) turned so that the first square is dark where that can be, else to the upper left."""
    turned = [np.rot90(corners, turns, axes=(0, 1)) for turns in range(4)]
    fitting = [way for way in turned if way.shape[:2] == (board.rows, board.columns)]
    dark = [way for way in fitting if _first_is_dark(image, way)] or fitting
    return min(dark, key=lambda way: float(np.nansum(way[0, 0])) if np.isfinite(way[0, 0, 0]) else np.inf)


def _first_is_dark(image: Grey, corners: Array) -> bool:
    middles = (corners[:-1, :-1] + corners[1:, :-1] + corners[:-1, 1:] + corners[1:, 1:]) / 4
    grey = np.where(np.isfinite(middles[..., 0]), sample(image, np.nan_to_num(middles)), np.nan)
    odd = np.indices(grey.shape).sum(axis=0) % 2 == 1
    return bool(np.nanmean(grey[~odd]) < np.nanmean(grey[odd]))
