"""OpenCV's two detectors of checkerboards, in a whole image and around corners that were found already."""

from __future__ import annotations

from collections.abc import Iterator

import cv2
import numpy as np
from numpy.typing import NDArray

from calib.boards.board import Board
from calib.boards.board_order import array_to_grid
from calib.boards.corner_grid import Grid, spacing, with_clockwise_axes
from calib.boards.derived_images import Image
from calib.models.camera import Array

PLAIN = cv2.CALIB_CB_ADAPTIVE_THRESH | cv2.CALIB_CB_NORMALIZE_IMAGE
SECTOR = cv2.CALIB_CB_NORMALIZE_IMAGE | cv2.CALIB_CB_EXHAUSTIVE
# The image is doubled: only for the part in which a board is likely, because it takes long.
DOUBLED = SECTOR | cv2.CALIB_CB_ACCURACY
# Distance at which two detectors' corners are the same, in parts of a square and at least: less than half of the
# smallest squares, otherwise a corner would be near two.
SAME_PART, SAME_PX = 0.25, 1.0
# Margin around known corners in parts of their extent, around an incomplete grid, and least margin.
MARGIN_PART, WIDE_MARGIN_PART, MIN_MARGIN_PX = 0.3, 1.5, 20


def opencv_grids(image: Image, board: Board) -> Iterator[Grid]:
    """Yield the grids of OpenCV's two detectors, of those that find the board."""
    is_found, corners = cv2.findChessboardCorners(image, (board.columns, board.rows), flags=PLAIN)
    if is_found:
        yield from _grid(corners, board)
    yield from _sector_grid(image, board, SECTOR)


def grids_nearby(image: Image, near: Grid, board: Board) -> Iterator[Grid]:
    """Yield the grid that OpenCV finds in the doubled part of the image around the corners of an incomplete grid."""
    part, low = _part_around(image, np.array(list(near.values())), WIDE_MARGIN_PART)
    for grid in _sector_grid(part, board, DOUBLED):
        yield {cell: pixel + low for cell, pixel in grid.items()}


def confirmed(image: Image, corners: Array, board: Board) -> bool:
    """True if one of OpenCV's detectors finds the corners (rows, columns, 2) in the part of the image around them."""
    part, low = _part_around(image, corners[np.isfinite(corners[..., 0])], MARGIN_PART)
    shown = array_to_grid(corners - low)
    return any(are_same(shown, grid) for grid in opencv_grids(part, board))


def _sector_grid(image: Image, board: Board, flags: int) -> Iterator[Grid]:
    is_found, corners = cv2.findChessboardCornersSB(image, (board.columns, board.rows), flags=flags)
    if is_found:
        yield from _grid(corners, board)


def _grid(corners: NDArray[np.generic], board: Board) -> Iterator[Grid]:
    """Yield the grid of the corners (N, 1, 2) that a detector found, if they are all of the board."""
    if len(corners) == board.columns * board.rows:
        yield with_clockwise_axes(array_to_grid(np.asarray(corners, float).reshape(board.rows, board.columns, 2)))


def _part_around(image: Image, pixels: Array, margin_part: float) -> tuple[Image, Array]:
    """Return the part of the image around pixels (N, 2), and the pixel (2,) of its first one."""
    margin = max(MIN_MARGIN_PX, margin_part * float(np.ptp(pixels, axis=0).max()))
    low = np.maximum(pixels.min(axis=0) - margin, 0).astype(int)
    high = (pixels.max(axis=0) + margin).astype(int)
    return np.ascontiguousarray(image[low[1] : high[1], low[0] : high[0]]), low.astype(float)


def are_same(grid: Grid, other: Grid) -> bool:
    """True if every corner of a grid is one of another grid, within a part of the squares."""
    return shared_part(grid, other) == 1


def shared_part(grid: Grid, other: Grid) -> float:
    """Return the share of a grid's corners that are those of another grid, within a part of the squares."""
    mine, theirs = (np.array(list(corners.values())) for corners in (grid, other))
    apart = np.linalg.norm(mine[:, None] - theirs, axis=2).min(axis=1)
    sizes = np.array([spacing(grid, cell) for cell in grid])
    return float((apart < np.maximum(SAME_PART * sizes, SAME_PX)).mean())
