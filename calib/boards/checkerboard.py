"""Detection of a checkerboard in a mirror image, by linked corner candidates.

Candidates of corners are linked to grids, which grow by the corners that they predict. A grid is accepted by one score:
how well the squares alternate within the board and in the ring of squares around its corners, minus how well they go on
beyond that ring, as brickwork and floors do.
"""

from __future__ import annotations

import numpy as np

from calib.boards.board import Board
from calib.boards.corner_candidates import Grey, Image, find_corners, sample, smoothed
from calib.boards.corner_grid import ALONG, Grid, find_grids, grow_grid, with_clockwise_axes
from calib.boards.local_mapping import local_mapping, quadratic_terms, refined_corners, without_outliers
from calib.models.camera import Array

# Least score of a board: right ones in hard renderings have 0.5 to 0.75, others 0.3 at most.
MIN_SCORE = 0.4
# Least share of known corners in each row and column of a board: one that is missing belongs to another size.
MIN_FILLED = 0.6


def find_board(image: Image, board: Board) -> Array | None:
    """Find the board in an image (H, W) uint8, its corners refined to a fraction of a pixel; None if there is none.

    Returns pixels (N, 2) in the order of board.points, NaN for unknown corners. The board's x and y axes turn clockwise
    in the image. The first square is dark where the board's sides (one even, one odd) determine it.
    """
    blurred, points = smoothed(image), board.points[:, :2] / board.square_m
    # Those nearest to the board's size come first.
    grids = sorted(find_grids(blurred, find_corners(image)), key=lambda grid: abs(np.log(len(grid) / len(points))))
    for grid in map(with_clockwise_axes, grids):
        # 1. Grow the grid by corners of the image itself.
        placed = _fullest_window(grow_grid(blurred, grid, _most_corners(board)), board)
        if placed is None or not _is_whole(placed):
            continue
        # 2. Refine its corners, and leave out outliers.
        placed = orient_corners(blurred, placed, board)
        corners = without_outliers(points, refined_corners(image, points, placed.reshape(-1, 2)))
        # 3. Accept it by its score.
        if _is_whole(corners.reshape(placed.shape)) and board_score(blurred, corners, board) >= MIN_SCORE:
            return corners
    return None


def board_score(image: Grey, corners: Array, board: Board) -> float:
    """Return the score of corners (N, 2) as a complete board: 1 at most, about 0 for a part of a larger pattern.

    Steps of grey between neighbouring squares count from -1 to 1 as a fraction of the median step within the board. The
    score is their mean within the board and in the ring of squares around its corners, as far as the image shows it,
    minus the largest mean of a side beyond.
    """
    level = _square_means(image, corners, board)
    sign = np.where(np.indices(level.shape).sum(axis=0) % 2 == 0, 1.0, -1.0)
    down, along = np.diff(level, axis=0) * sign[1:], np.diff(level, axis=1) * sign[:, 1:]
    usual = float(np.nanmedian(np.concatenate([down[2:-2, 2:-2].ravel(), along[2:-2, 2:-2].ravel()])))
    down, along = (np.clip(steps / usual, -1, 1) for steps in (down, along))
    sides = (
        (along[0, 1:-1], down[0, 1:-1]),
        (along[-1, 1:-1], down[-1, 1:-1]),
        (down[1:-1, 0], along[1:-1, 0]),
        (down[1:-1, -1], along[1:-1, -1]),
    )
    beyond = max(float(np.nan_to_num(np.concatenate(side)).mean()) for side in sides)
    return float(np.nanmean(np.concatenate([down[1:-1, 1:-1].ravel(), along[1:-1, 1:-1].ravel()]))) - beyond


def _square_means(image: Grey, corners: Array, board: Board) -> Array:
    """Return the mean grey (rows + 3, columns + 3) of the squares between corners and in two rings around them.

    NaN where no mapping is known, and outside of the image.
    """
    points, known = board.points[:, :2] / board.square_m, np.isfinite(corners[:, 0])
    level = np.full((board.rows + 3, board.columns + 3), np.nan)
    x, y = np.meshgrid(ALONG, ALONG)
    for row, column in np.ndindex(level.shape):
        place = np.clip([column - 2, row - 2], 0, [board.columns - 1, board.rows - 1]).astype(float)
        mapping = local_mapping(place, points[known], corners[known], exact=True)
        if mapping is not None:
            terms = quadratic_terms(x + column - 2 - place[0], y + row - 2 - place[1])
            pixels = terms @ mapping.coefficients
            inside = ((pixels >= 0) & (pixels <= np.array(image.shape[::-1]) - 1)).all()
            level[row, column] = sample(image, pixels).mean() if inside else np.nan
    return level


def _most_corners(board: Board) -> int:
    """Return the number of corners beyond which a grid is no board, but a floor: false ones may surround a board."""
    return (board.columns + 2) * (board.rows + 2)


def _is_whole(corners: Array) -> bool:
    """True if enough corners (rows, columns, 2) are known in each row and in each column."""
    known = np.isfinite(corners[..., 0])
    return bool(min(known.mean(axis=0).min(), known.mean(axis=1).min()) >= MIN_FILLED)


def _fullest_window(grid: Grid, board: Board) -> Array | None:
    """Return the corners (rows, columns, 2) of the window of the board's size, upright or rotated, that has the most.

    Corners that are not known are NaN. None for a grid that is smaller, or a floor.
    """
    if len(grid) > _most_corners(board):
        return None
    cells = np.array(list(grid))
    cells -= cells.min(axis=0)
    corners = np.full((*cells.max(axis=0)[::-1] + 1, 2), np.nan)
    corners[cells[:, 1], cells[:, 0]] = np.array(list(grid.values()))
    windows = [
        window
        for upright in (corners, np.rot90(corners))
        if upright.shape[0] >= board.rows and upright.shape[1] >= board.columns
        for window in np.lib.stride_tricks.sliding_window_view(upright, (board.rows, board.columns), (0, 1)).reshape(
            -1, 2, board.rows, board.columns
        )
    ]
    best = max(windows, key=lambda window: np.isfinite(window[0]).sum(), default=None)
    return None if best is None else np.moveaxis(best, 0, -1)


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
