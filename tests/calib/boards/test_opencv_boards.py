"""OpenCV's detectors: grids in an image and around known corners, and whether they agree."""

from __future__ import annotations

import numpy as np
import pytest

from calib.boards.opencv_boards import are_same, confirmed, grids_nearby, opencv_grids, shared_part
from tests.calib.boards.sheets import BOARD, sheet


def test_both_detectors_find_the_board_and_none_where_there_is_none() -> None:
    seen = sheet()
    grids = list(opencv_grids(seen.image, BOARD))
    assert len(grids) == 2 and all(len(grid) == BOARD.columns * BOARD.rows for grid in grids)
    assert all(are_same(seen.grid, grid) for grid in grids)
    assert list(opencv_grids(np.full_like(seen.image, 90), BOARD)) == []


def test_the_part_around_an_incomplete_grid_is_searched_in_pixels_of_the_image() -> None:
    seen = sheet(scale=0.6)
    part = {cell: pixel for cell, pixel in seen.grid.items() if cell[0] < 5 and cell[1] < 4}
    grids = list(grids_nearby(seen.image, part, BOARD))
    assert grids and are_same(seen.grid, grids[0])


def test_corners_are_confirmed_where_the_image_shows_them() -> None:
    seen = sheet()
    assert confirmed(seen.image, seen.corners, BOARD)
    assert not confirmed(seen.image, seen.corners + np.array([12.0, 0.0]), BOARD)


@pytest.mark.parametrize(("moved_px", "share"), [(5.0, 1.0), (7.0, 0.0)])
def test_corners_are_the_same_within_a_quarter_of_a_square(moved_px: float, share: float) -> None:
    grid = sheet().grid
    assert shared_part(grid, {cell: pixel + np.array([moved_px, 0]) for cell, pixel in grid.items()}) == share
