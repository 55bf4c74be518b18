"""Selection of the board's window in a grid of corners, and the orientation of its corners."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from calib.boards.board import Board
from calib.boards.corner_candidates import Grey, sample
from calib.boards.corner_grid import Grid
from calib.models.camera import Array

# Least share of known corners in the whole board, and in each of its four borders: a row that is missing belongs to a
# board of another size.
MIN_FILLED, MIN_BORDER = 0.8, 0.6
# A row just outside with at least this share of corners belongs to a larger board.
BEYOND = 0.7


def select_board_window(grid: Grid, board: Board) -> Array | None:
    """Return the corners (rows, columns, 2), NaN if hidden, of the grid's fullest isolated window of the board's size.

    None if there is no such window.
    """
    return max(_board_windows(grid, board), key=lambda window: float(np.isfinite(window).mean()), default=None)


def grid_to_array(grid: Grid) -> Array:
    """Return the grid as an array (rows, columns, 2) with a border of two NaN on all sides."""
    cells = np.array(list(grid))
    low, high = cells.min(axis=0) - 2, cells.max(axis=0) + 2
    corners = np.full((high[1] - low[1] + 1, high[0] - low[0] + 1, 2), np.nan)
    for (i, j), pixel in grid.items():
        corners[j - low[1], i - low[0]] = pixel
    return corners


def array_to_grid(corners: Array) -> Grid:
    """Return the known corners of an array (rows, columns, 2) by (column, row)."""
    return {(int(i), int(j)): corners[j, i] for j, i in np.argwhere(np.isfinite(corners[..., 0]))}


def _board_windows(grid: Grid, board: Board) -> Iterator[Array]:
    """Yield every window of the board's size, upright or rotated, that is well filled and has no row beyond it."""
    for upright in (grid_to_array(grid), np.rot90(grid_to_array(grid))):
        known = np.isfinite(upright[..., 0])
        if known.shape[0] < board.rows + 2 or known.shape[1] < board.columns + 2:
            continue
        around = np.lib.stride_tricks.sliding_window_view(known, (board.rows + 2, board.columns + 2))
        inside = around[..., 1:-1, 1:-1]
        beyond = [around[..., 0, 1:-1], around[..., -1, 1:-1], around[..., 1:-1, 0], around[..., 1:-1, -1]]
        borders = [inside[..., 0, :], inside[..., -1, :], inside[..., 0], inside[..., -1]]
        isolated = inside.mean(axis=(-2, -1)) >= MIN_FILLED
        isolated &= np.min([border.mean(axis=-1) for border in borders], axis=0) >= MIN_BORDER
        isolated &= np.max([row.mean(axis=-1) for row in beyond], axis=0) < BEYOND
        for j, i in np.argwhere(isolated) + 1:
            yield upright[j : j + board.rows, i : i + board.columns]


def largest_rectangle(grid: Grid) -> tuple[int, int]:
    """Return columns and rows of the largest full rectangle in a grid: the size of a board that may be present."""
    known = np.isfinite(grid_to_array(grid)[..., 0])
    heights, best = np.zeros(known.shape[1], int), (0, 0)
    widths = np.arange(1, known.shape[1] + 1)
    for row in known:
        heights = np.where(row, heights + 1, 0)
        for i in np.flatnonzero(heights):
            lowest = np.minimum.accumulate(heights[i:])
            width = int(np.argmax(lowest * widths[: len(lowest)])) + 1
            best = max(best, (width, int(lowest[width - 1])), key=lambda sides: sides[0] * sides[1])
    return best


def orient_corners(image: Grey, corners: Array, board: Board) -> Array:
    """Return the corners (rows, columns, 2) rotated so that the first square is dark.

    If several orders satisfy that, or none does, the first corner is the one nearest the image's upper left.
    """
    rotated = [np.rot90(corners, turns, axes=(0, 1)) for turns in range(4)]
    fitting = [order for order in rotated if order.shape[:2] == (board.rows, board.columns)]
    odd = np.indices((board.rows - 1, board.columns - 1)).sum(axis=0) % 2 == 1

    def is_dark(order: Array) -> bool:
        """True if the first square, and those of its colour, are darker than the others."""
        middles = (order[:-1, :-1] + order[1:, :-1] + order[:-1, 1:] + order[1:, 1:]) / 4
        grey = np.where(np.isfinite(middles[..., 0]), sample(image, np.nan_to_num(middles)), np.nan)
        return bool(np.nanmean(grey[~odd]) < np.nanmean(grey[odd]))

    dark = [order for order in fitting if is_dark(order)] or fitting
    return min(dark, key=lambda order: float(np.nansum(order[0, 0])) if np.isfinite(order[0, 0, 0]) else np.inf)
