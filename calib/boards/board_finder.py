"""Detection of a checkerboard in a mirror image: by linked corner candidates first, then by OpenCV's detectors.

The search covers the original image, the image with raised local contrast, the enlarged image, and two log-polar
strips about the image's middle. A log-polar strip is conformal: squares stay square, and boards near the hub become
larger and lose their fan shape.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import lru_cache, partial
from itertools import islice

import cv2
import numpy as np
from numpy.typing import NDArray

from calib.boards.board import Board, BoardView
from calib.boards.board_order import array_to_grid, largest_rectangle, orient_corners, select_board_window
from calib.boards.board_shape import grid_irregularity, has_checker_pattern, is_complete_board
from calib.boards.corner_candidates import Grey, describe_corners, find_corners, smoothed
from calib.boards.corner_grid import MIN_RING_PX, RING_PART, Grid, find_grids, grow_grid, spacing
from calib.boards.corner_refinement import refine_corners
from calib.models.camera import Array

Image = NDArray[np.uint8]
# Smaller images are not searched.
MIN_SIDE_PX = 32
# Standard deviation of the Gaussian blur before grey levels are sampled.
BLUR_PX = 0.7
# Number of grids per image that are grown and checked: those closest to the board's corner count.
TRIED_GRIDS = 5
# Largest distance of a corner from the position its neighbours predict, in parts of a square.
MAX_IRREGULARITY = 0.2
# Least share of accepted corners in a detected board.
MIN_GOOD = 0.75
# Larger images are not enlarged: their boards have enough pixels.
MAX_ENLARGED_PIXELS = 1_600_000
# Largest width of a log-polar strip.
MAX_STRIP_PX = 2400
# Inner and outer radius of a log-polar strip, in parts of the image's smaller side.
STRIP_INNER_PART, STRIP_OUTER_PART = 1 / 16, 1 / 2
# CLAHE (contrast limited adaptive histogram equalisation): clip limit and number of tiles per axis.
CLAHE_CLIP_LIMIT, CLAHE_TILES = 4.0, 8
# OpenCV's detectors, and the distance at which their corners are the same, in parts of a square and at least.
DETECTORS, SAME_PART, SAME_PX = 2, 0.25, 1.0
# A smaller grid is not reported as a board of another size.
MIN_HINT_CORNERS = 12
MIN_HINT_SIDE = 3


@dataclass(frozen=True, slots=True)
class BoardSearch:
    """The result for one image: the board's view, or the size (columns, rows) of another grid, (0, 0) for none."""

    view: BoardView | None
    grid_size: tuple[int, int] = (0, 0)


@dataclass(frozen=True, slots=True)
class _SearchImage:
    """An image derived from the source image; to_source maps its pixels (N, 2) to source pixels (N, 2)."""

    image: Image
    to_source: Callable[[Array], Array]


def find_board(image: Image, board: Board, name: str = "", *, thorough: bool = True) -> BoardSearch:
    """Find the board in an image (H, W) uint8, its corners refined to a fraction of a pixel.

    thorough=False searches the original image only, about 0.1 s per megapixel: for logs with many frames.
    """
    largest = (0, 0)
    if min(image.shape) < MIN_SIDE_PX:
        return BoardSearch(None)
    blurred = smoothed(image, BLUR_PX)
    for searched in _search_images(image) if thorough else islice(_search_images(image), 1):
        for candidate in _grids(searched, board):
            grid = grow_grid(blurred, candidate)
            view = _checked_view(image, grid, board, name)
            if view is not None:
                return BoardSearch(view)
            largest = max(largest, largest_rectangle(grid), key=lambda sides: sides[0] * sides[1])
    detected = list(_opencv_grids(image, board)) if thorough else []
    for grid in detected:
        view = _checked_view(image, grow_grid(blurred, grid), board, name)
        if view is not None:
            return BoardSearch(view)
    # The outermost squares of a near board lie outside the image or in shadow: two detectors that agree are enough.
    if len(detected) == DETECTORS and _are_same(detected[0], detected[1]):
        view = _checked_view(image, detected[0], board, name, complete=False)
        if view is not None:
            return BoardSearch(view)
    is_hint = min(largest) >= MIN_HINT_SIDE and largest[0] * largest[1] >= MIN_HINT_CORNERS
    return BoardSearch(None, largest if is_hint else (0, 0))


def _search_images(image: Image) -> Iterator[_SearchImage]:
    """Yield the image and its derived images, the cheapest first."""
    yield _SearchImage(image, lambda pixels: pixels)
    yield _SearchImage(_contrasted(image), lambda pixels: pixels)
    if image.size <= MAX_ENLARGED_PIXELS:
        enlarged = cv2.resize(image, None, fx=2, fy=2, interpolation=cv2.INTER_CUBIC).astype(np.uint8, copy=False)
        yield _SearchImage(enlarged, lambda pixels: (pixels + 0.5) / 2 - 0.5)
    for start_rad in (0.0, np.pi):
        yield _unrolled(image, start_rad)


def _contrasted(image: Image) -> Image:
    return cv2.createCLAHE(CLAHE_CLIP_LIMIT, (CLAHE_TILES,) * 2).apply(image).astype(np.uint8, copy=False)


def _unrolled(image: Image, start_rad: float) -> _SearchImage:
    """Return the log-polar strip about the image's middle: azimuth to the right, logarithm of the radius upwards."""
    height, width = image.shape
    strip = cv2.remap(image, *_strip_maps((height, width), start_rad), cv2.INTER_CUBIC)
    return _SearchImage(strip.astype(np.uint8, copy=False), partial(_strip_to_source, (height, width), start_rad))


def _strip_scale(shape: tuple[int, int]) -> tuple[float, float, float]:
    """Return inner and outer radius [px] of a strip, and its pixels per radian."""
    inner, outer = min(shape) * STRIP_INNER_PART, max(shape) * STRIP_OUTER_PART
    return inner, outer, min(MAX_STRIP_PX, 2 * np.pi * outer) / (2 * np.pi)


def _strip_to_source(shape: tuple[int, int], start_rad: float, pixels: Array) -> Array:
    """Return the pixels (N, 2) of an image of that shape for pixels (N, 2) of its strip."""
    _, outer, scale = _strip_scale(shape)
    azimuth, radius = start_rad + pixels[:, 0] / scale, outer * np.exp(-pixels[:, 1] / scale)
    middle = np.array([(shape[1] - 1) / 2, (shape[0] - 1) / 2])
    return np.asarray(middle + radius[:, None] * np.column_stack([np.cos(azimuth), np.sin(azimuth)]))


@lru_cache(maxsize=2)
def _strip_maps(shape: tuple[int, int], start_rad: float) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Return the tables of a strip for cv2.remap; the images of a camera have one shape."""
    inner, outer, scale = _strip_scale(shape)
    columns, rows = np.meshgrid(np.arange(int(2 * np.pi * scale)), np.arange(int(np.log(outer / inner) * scale)))
    maps = _strip_to_source(shape, start_rad, np.column_stack([columns.ravel(), rows.ravel()]).astype(float))
    u, v = maps.astype(np.float32).T.reshape(2, *columns.shape)
    return np.ascontiguousarray(u), np.ascontiguousarray(v)


def _grids(searched: _SearchImage, board: Board) -> Iterator[Grid]:
    """Yield grids of linked corners in pixels of the source image."""
    blurred = smoothed(searched.image, BLUR_PX)
    for grid in _nearest_in_size(find_grids(blurred, find_corners(searched.image)), board):
        yield _to_source_pixels(grow_grid(blurred, grid), searched)


def _nearest_in_size(grids: list[Grid], board: Board) -> list[Grid]:
    """Select the grids closest to the board's size, and the largest: it may contain the board or show another count."""
    size = board.columns * board.rows
    near = sorted(grids, key=lambda grid: abs(np.log(len(grid) / size)))[:TRIED_GRIDS]
    return [*near, *(grid for grid in grids[:1] if not any(grid is one for one in near))]


def _opencv_grids(image: Image, board: Board) -> Iterator[Grid]:
    """Yield the grids of OpenCV's two detectors."""
    size = (board.columns, board.rows)
    sector = cv2.CALIB_CB_NORMALIZE_IMAGE | cv2.CALIB_CB_EXHAUSTIVE | cv2.CALIB_CB_ACCURACY
    for detect, flags in ((cv2.findChessboardCornersSB, sector),
                          (cv2.findChessboardCorners, cv2.CALIB_CB_ADAPTIVE_THRESH | cv2.CALIB_CB_NORMALIZE_IMAGE)):
        found, corners = detect(image, size, flags=flags)
        if found and corners is not None and len(corners) == board.columns * board.rows:
            yield _with_clockwise_axes(array_to_grid(np.asarray(corners, float).reshape(board.rows, board.columns, 2)))


def _are_same(grid: Grid, other: Grid) -> bool:
    """True if every corner of a grid is one of another grid, within a part of the squares."""
    mine, theirs = (np.array(list(corners.values())) for corners in (grid, other))
    apart = np.linalg.norm(mine[:, None] - theirs, axis=2).min(axis=1)
    sizes = np.array([spacing(grid, cell) for cell in grid])
    return bool((apart < np.maximum(SAME_PART * sizes, SAME_PX)).all())


def _to_source_pixels(grid: Grid, searched: _SearchImage) -> Grid:
    """Return the grid in pixels of the source image."""
    pixels = searched.to_source(np.array(list(grid.values())))
    return _with_clockwise_axes(dict(zip(grid, pixels, strict=True)))


def _with_clockwise_axes(grid: Grid) -> Grid:
    """Return the grid, its axes swapped if necessary, so that columns turn clockwise to rows."""
    return grid if _is_clockwise(grid) else {(row, column): pixel for (column, row), pixel in grid.items()}


def _is_clockwise(grid: Grid) -> bool:
    turns = [np.linalg.det(np.stack([along - corner, down - corner])) for (i, j), corner in grid.items()
             if (along := grid.get((i + 1, j))) is not None and (down := grid.get((i, j + 1))) is not None]
    return bool(np.sum(np.sign(turns)) >= 0)


def _checked_view(image: Image, grid: Grid, board: Board, name: str, *, complete: bool = True) -> BoardView | None:
    """Return the board's view in a grid, or None if a check of its corners or squares fails.

    complete: the squares around the corners are checked as well.
    """
    placed = select_board_window(grid, board)
    if placed is None:
        return None
    blurred = smoothed(image, BLUR_PX)
    refined = refine_corners(image, orient_corners(blurred, placed, board))
    good = _without_outliers(blurred, refined)
    part = float(np.isfinite(good[..., 0]).mean())
    if part < MIN_GOOD or not has_checker_pattern(blurred, good):
        return None
    if complete and not is_complete_board(blurred, refined):
        return None
    return BoardView(name, good.reshape(-1, 2), part * (1 - float(np.nanmean(grid_irregularity(good)))))


def _without_outliers(blurred: Grey, corners: Array) -> Array:
    """Return the corners (rows, columns, 2) with NaN for those without a corner's ring or off the regular grid."""
    good = corners.copy()
    good[~_corner_mask(blurred, corners)] = np.nan
    for _ in range(good.shape[0] * good.shape[1]):
        off = grid_irregularity(good)
        worst = np.unravel_index(np.argmax(np.nan_to_num(off)), off.shape)
        if not off[worst] > MAX_IRREGULARITY:
            break
        # One at a time: an outlier raises the irregularity of its neighbours.
        good[worst] = np.nan
    return good


def _corner_mask(blurred: Grey, corners: Array) -> NDArray[np.bool_]:
    """Return the mask (rows, columns) of pixels whose ring of grey levels is that of a corner."""
    grid = array_to_grid(corners)
    rings = np.array([max(MIN_RING_PX, RING_PART * spacing(grid, cell)) for cell in grid])
    likely = np.zeros(corners.shape[:2], bool)
    column, row = np.array(list(grid)).T
    likely[row, column] = describe_corners(blurred, np.array(list(grid.values())), rings).quality > 0
    return likely
