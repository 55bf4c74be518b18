"""Detection of a checkerboard in a mirror image, by linked corner candidates.

Corners are linked in the original image, the enlarged image, and a log-polar strip about the image's middle. A grid of
them is accepted by one score: how well the squares alternate within the board and in the ring of squares around its
corners, minus how well they go on beyond that ring, as brickwork and floors do.
"""

from __future__ import annotations

from collections.abc import Iterator
from itertools import islice

import numpy as np

from calib.boards.board import Board, BoardView
from calib.boards.corner_candidates import (
    BLUR_PX,
    DerivedImage,
    Grey,
    Image,
    derived_images,
    describe_corners,
    find_corners,
    sample,
    smoothed,
)
from calib.boards.corner_grid import ALONG, MIN_RING_PX, WINDOW_PART, Grid, find_grids, grow_grid, with_clockwise_axes
from calib.boards.local_mapping import (
    local_mapping,
    mapping_of_others,
    quadratic_terms,
    refined_corners,
    without_outliers,
)
from calib.models.camera import Array

# Shorter side of the smallest image that is searched.
MIN_SIDE_PX = 32
# Number of grids per image that are grown and checked, those closest to the board's corner count.
TRIED_GRIDS = 5
# Least score of a board: right ones in hard renderings have 0.5 to 0.75, others 0.3 at most.
MIN_SCORE = 0.4


def find_board(image: Image, board: Board, name: str = "", *, thorough: bool = True) -> BoardView | None:
    """Find the board in an image (H, W) uint8, its corners refined to a fraction of a pixel; None if there is none.

    thorough=False searches the original image only, about 0.1 s per megapixel: for logs with many frames.
    """
    if min(image.shape) < MIN_SIDE_PX:
        return None
    blurred, has_floor = smoothed(image, BLUR_PX), False
    for searched in derived_images(image) if thorough else islice(derived_images(image), 1):
        # 1. Grow the grids by corners of the image itself. A floor is torn where its squares do not fit together, so a
        #    part of it may look like a board with a few corners too many.
        grids = [grow_grid(blurred, candidate, _most_corners(board)) for candidate in _grids(searched, board)]
        has_floor |= any(len(grid) > (board.columns + 2) * (board.rows + 2) for grid in grids)
        for grid in grids:
            is_floor = has_floor and len(grid) > board.columns * board.rows
            windows = [] if is_floor else list(_board_windows(grid, board))
            if not windows:
                continue
            placed = max(windows, key=lambda window: float(np.isfinite(window).mean()))  # the fullest
            # 2. Refine its corners, and leave out false ones and outliers.
            corners = _refined(image, blurred, orient_corners(blurred, placed, board), board)
            share = float(np.isfinite(corners[:, 0]).mean())
            # 3. Accept it by its score.
            if share >= MIN_FILLED and board_score(blurred, corners, board) >= MIN_SCORE:
                return BoardView(name, corners)
    return None


def _refined(image: Image, blurred: Grey, placed: Array, board: Board) -> Array:
    """Return the corners (N, 2) of a window (rows, columns, 2), refined, with NaN for those that are not accepted."""
    points = board.points[:, :2] / board.square_m
    pixels = refined_corners(image, points, placed.reshape(-1, 2))
    # The ring of grey levels must be that of a corner.
    known = np.isfinite(pixels[:, 0])
    mappings = [mapping_of_others(points, pixels, k) for k in np.flatnonzero(known).tolist()]
    sizes = np.array([0.0 if mapping is None else mapping.side_px for mapping in mappings])
    known[known] = describe_corners(blurred, pixels[known], np.maximum(MIN_RING_PX, WINDOW_PART * sizes)).quality > 0
    return without_outliers(points, np.where(known[:, None], pixels, np.nan))


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


def _grids(searched: DerivedImage, board: Board) -> Iterator[Grid]:
    """Yield grids of linked corners in pixels of the source image: those nearest to the board's size, and the largest.

    The largest may contain the board, or show another count.
    """
    blurred = smoothed(searched.image, BLUR_PX)
    grids, size = find_grids(blurred, find_corners(searched.image)), board.columns * board.rows
    near = sorted(grids, key=lambda grid: abs(np.log(len(grid) / size)))[:TRIED_GRIDS]
    for grid in [*near, *(grid for grid in grids[:1] if not any(grid is one for one in near))]:
        grown = grow_grid(blurred, grid, _most_corners(board))
        pixels = searched.to_source(np.array(list(grown.values())))
        yield with_clockwise_axes(dict(zip(grown, pixels, strict=True)))


def _most_corners(board: Board) -> int:
    """Return the number of corners beyond which a grid is no board, and does not grow: a floor has thousands."""
    return 3 * (board.columns + 2) * (board.rows + 2)


# Least share of known corners in the whole board, and in each of its four borders: a row that is missing belongs to a
# board of another size. A row just outside with that share of corners belongs to a larger board.
MIN_FILLED, MIN_BORDER = 0.8, 0.6


def grid_to_array(grid: Grid) -> Array:
    """Return the grid as an array (rows, columns, 2) with a border of two NaN on all sides."""
    cells = np.array(list(grid))
    low, high = cells.min(axis=0) - 2, cells.max(axis=0) + 2
    corners = np.full((high[1] - low[1] + 1, high[0] - low[0] + 1, 2), np.nan)
    for (i, j), pixel in grid.items():
        corners[j - low[1], i - low[0]] = pixel
    return corners


def _board_windows(grid: Grid, board: Board) -> Iterator[Array]:
    """Yield every window of the board's size, upright or rotated, that is well filled and has no row beyond it.

    Its corners (rows, columns, 2), NaN if hidden.
    """
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
        isolated &= np.max([row.mean(axis=-1) for row in beyond], axis=0) < MIN_BORDER
        for j, i in np.argwhere(isolated) + 1:
            yield upright[j : j + board.rows, i : i + board.columns]


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
