"""Finds a checkerboard in a mirror's image: by linked corners first, then by OpenCV's detectors.

Linked corners are looked for in the image as it is, with its local contrast raised, enlarged, and unrolled about its
middle: on a log-polar strip, which keeps small squares square, boards near the hub grow and lose their fan shape.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from itertools import islice

import cv2
import numpy as np
from numpy.typing import NDArray

from calib.boards.board import Board, BoardView
from calib.boards.board_order import as_grid, in_order, largest_board, place
from calib.boards.board_shape import is_printed, is_whole, unevenness
from calib.boards.corner_candidates import Grey, find_corners, look_at, smoothed
from calib.boards.corner_grid import MIN_RING_PX, RING_PART, Grid, find_grids, grow, spacing
from calib.boards.corner_refinement import refine
from calib.models.camera import Array

Image = NDArray[np.uint8]
MIN_SIDE_PX = 32
BLUR_PX = 0.7
# Of a image's grids so many are grown and tried: those of nearly as many corners as the board has, and the largest.
TRIED_GRIDS = 5
# What a corner may lie off its neighbours, in parts of a square; so many must be good, or the whole is no board.
MAX_UNEVEN = 0.2
MIN_GOOD = 0.75
# Images larger than this are not enlarged.
MAX_ENLARGED_PIXELS = 1_600_000
MAX_STRIP_PX = 2400
# A grid smaller than this hints at no board.
MIN_HINT_CORNERS = 12
MIN_HINT_SIDE = 3


@dataclass(frozen=True, slots=True)
class BoardSearch:
    """What came of a image: the board, or what grid (columns, rows) was seen in its stead, (0, 0) for none."""

    view: BoardView | None
    seen: tuple[int, int] = (0, 0)


@dataclass(frozen=True, slots=True)
class _Look:
    """A image made from another, and where (N, 2) in that one its pixels (N, 2) come from."""

    image: Image
    origin: Callable[[Array], Array]


def find_board(image: Image, board: Board, name: str = "", *, thorough: bool = True) -> BoardSearch:
    """The board in a image (H, W) uint8, its corners to a fraction of a pixel.

    Not thorough: one look, some 0.1 s for a megapixel, for frames of which there are plenty.
    """
    seen = (0, 0)
    if min(image.shape) < MIN_SIDE_PX:
        return BoardSearch(None)
    blurred = smoothed(image, BLUR_PX)
    for look in _looks(image) if thorough else islice(_looks(image), 1):
        for looked_at in _grids(look, board):
            grid = grow(blurred, looked_at)
            view = _view(image, grid, board, name)
            if view is not None:
                return BoardSearch(view)
            seen = max(seen, largest_board(grid), key=lambda sides: sides[0] * sides[1])
    for grid in _by_opencv(image, board) if thorough else ():
        view = _view(image, grow(blurred, grid), board, name)
        if view is not None:
            return BoardSearch(view)
    hint = min(seen) >= MIN_HINT_SIDE and seen[0] * seen[1] >= MIN_HINT_CORNERS
    return BoardSearch(None, seen if hint else (0, 0))


def _looks(image: Image) -> Iterator[_Look]:
    yield _Look(image, lambda pixels: pixels)
    yield _Look(_contrasted(image), lambda pixels: pixels)
    if image.size <= MAX_ENLARGED_PIXELS:
        enlarged = cv2.resize(image, None, fx=2, fy=2, interpolation=cv2.INTER_CUBIC).astype(np.uint8, copy=False)
        yield _Look(enlarged, lambda pixels: (pixels + 0.5) / 2 - 0.5)
    for start_rad in (0.0, np.pi):
        yield _unrolled(image, start_rad)


def _contrasted(image: Image) -> Image:
    return cv2.createCLAHE(4.0, (8, 8)).apply(image).astype(np.uint8, copy=False)


def _unrolled(image: Image, start_rad: float) -> _Look:
    """The image about its middle: azimuth from left to right, the logarithm of the radius upwards."""
    height, width = image.shape
    middle, inner, outer = np.array([(width - 1) / 2, (height - 1) / 2]), min(image.shape) / 16, max(image.shape) / 2
    scale = min(MAX_STRIP_PX, 2 * np.pi * outer) / (2 * np.pi)  # pixels per radian

    def origin(pixels: Array) -> Array:
        azimuth, radius = start_rad + pixels[:, 0] / scale, outer * np.exp(-pixels[:, 1] / scale)
        return np.asarray(middle + radius[:, None] * np.column_stack([np.cos(azimuth), np.sin(azimuth)]))

    columns, rows = np.meshgrid(np.arange(int(2 * np.pi * scale)), np.arange(int(np.log(outer / inner) * scale)))
    maps = origin(np.column_stack([columns.ravel(), rows.ravel()]).astype(float)).astype(np.float32)
    u, v = maps.T.reshape(2, *columns.shape)
    strip = cv2.remap(image, np.ascontiguousarray(u), np.ascontiguousarray(v), cv2.INTER_CUBIC)
    return _Look(strip.astype(np.uint8, copy=False), origin)


def _grids(look: _Look, board: Board) -> Iterator[Grid]:
    """Grids of linked corners, in the pixels of the first image."""
    blurred = smoothed(look.image, BLUR_PX)
    for grid in _likeliest(find_grids(blurred, find_corners(look.image)), board):
        yield _back(grow(blurred, grid), look)


def _likeliest(grids: list[Grid], board: Board) -> list[Grid]:
    """Those of about the board's size, and the largest, which may hold it or tell of a wrong count."""
    size = board.columns * board.rows
    near = sorted(grids, key=lambda grid: abs(np.log(len(grid) / size)))[:TRIED_GRIDS]
    return [*near, *(grid for grid in grids[:1] if not any(grid is one for one in near))]


def _by_opencv(image: Image, board: Board) -> Iterator[Grid]:
    """What OpenCV's two detectors find."""
    size = (board.columns, board.rows)
    sector = cv2.CALIB_CB_NORMALIZE_IMAGE | cv2.CALIB_CB_EXHAUSTIVE | cv2.CALIB_CB_ACCURACY
    for detect, flags in ((cv2.findChessboardCornersSB, sector),
                          (cv2.findChessboardCorners, cv2.CALIB_CB_ADAPTIVE_THRESH | cv2.CALIB_CB_NORMALIZE_IMAGE)):
        found, corners = detect(image, size, flags=flags)
        if found and corners is not None and len(corners) == board.columns * board.rows:
            yield _upright(as_grid(np.asarray(corners, float).reshape(board.rows, board.columns, 2)))


def _back(grid: Grid, look: _Look) -> Grid:
    """The grid in the first image."""
    pixels = look.origin(np.array(list(grid.values())))
    return _upright(dict(zip(grid, pixels, strict=True)))


def _upright(grid: Grid) -> Grid:
    """The grid with columns turning clockwise to rows."""
    return grid if _clockwise(grid) else {(row, column): pixel for (column, row), pixel in grid.items()}


def _clockwise(grid: Grid) -> bool:
    turns = [np.linalg.det(np.stack([along - corner, down - corner])) for (i, j), corner in grid.items()
             if (along := grid.get((i + 1, j))) is not None and (down := grid.get((i, j + 1))) is not None]
    return bool(np.sum(np.sign(turns)) >= 0)


def _view(image: Image, grid: Grid, board: Board, name: str) -> BoardView | None:
    """The board in a grid, if it passes its own checks."""
    placed = place(grid, board)
    if placed is None:
        return None
    blurred = smoothed(image, BLUR_PX)
    refined = refine(image, in_order(blurred, placed, board))
    good = _without_strays(blurred, refined)
    part = float(np.isfinite(good[..., 0]).mean())
    if part < MIN_GOOD or not is_printed(blurred, good) or not is_whole(blurred, refined):
        return None
    return BoardView(name, good.reshape(-1, 2), part * (1 - float(np.nanmean(unevenness(good)))))


def _without_strays(blurred: Grey, corners: Array) -> Array:
    """The corners (rows, columns, 2) with NaN for those that do not look like one or lie where none should."""
    good = corners.copy()
    good[~_likely(blurred, corners)] = np.nan
    for _ in range(good.shape[0] * good.shape[1]):
        off = unevenness(good)
        worst = np.unravel_index(np.argmax(np.nan_to_num(off)), off.shape)
        if not off[worst] > MAX_UNEVEN:
            break
        good[worst] = np.nan  # one at a time: a stray makes its neighbours look uneven too
    return good


def _likely(blurred: Grey, corners: Array) -> NDArray[np.bool_]:
    """Which of the corners (rows, columns) look like ones."""
    grid = as_grid(corners)
    rings = np.array([max(MIN_RING_PX, RING_PART * spacing(grid, cell)) for cell in grid])
    likely = np.zeros(corners.shape[:2], bool)
    column, row = np.array(list(grid)).T
    likely[row, column] = look_at(blurred, np.array(list(grid.values())), rings).quality > 0
    return likely
