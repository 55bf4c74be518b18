"""Grids of corners: linked, grown where the image shows what their neighbours predict, with axes clockwise."""

from __future__ import annotations

import numpy as np
import pytest

from calib.boards.corner_candidates import find_corners, smoothed
from calib.boards.corner_grid import find_grids, grow_grid, predict, refine_subpixel, spacing, with_clockwise_axes
from tests.calib.boards.sheets import BOARD, sheet

COUNT = BOARD.columns * BOARD.rows


def test_the_corners_of_a_board_are_one_grid() -> None:
    seen = sheet()
    grids = find_grids(smoothed(seen.image, 0.7), find_corners(seen.image))
    assert len(grids) == 1 and len(grids[0]) == COUNT
    sides = [max(cells) - min(cells) + 1 for cells in zip(*grids[0], strict=True)]
    assert sorted(sides) == [BOARD.rows, BOARD.columns]


def test_a_part_of_a_grid_grows_to_the_whole_board_and_no_further() -> None:
    seen = sheet()
    part = {cell: pixel for cell, pixel in seen.grid.items() if max(cell) < 3}
    grown = grow_grid(seen.grey, part, 60)
    assert grown.keys() == seen.grid.keys()
    assert max(np.linalg.norm(grown[cell] - pixel) for cell, pixel in seen.grid.items()) < 0.3
    assert len(grow_grid(seen.grey, part, 8)) == len(part), "it is large enough"


def test_a_hidden_corner_is_not_invented() -> None:
    seen = sheet()
    image = seen.grey.copy()
    u, v = seen.corners[2, 3].round().astype(int)
    image[v - 8 : v + 9, u - 8 : u + 9] = 128
    grid = {cell: pixel for cell, pixel in seen.grid.items() if cell != (3, 2)}
    assert (3, 2) not in grow_grid(image, grid, 60) and (3, 2) in grow_grid(seen.grey, grid, 60)


def test_a_corner_is_predicted_by_its_neighbours() -> None:
    grid = sheet().grid
    inner = {cell: pixel for cell, pixel in grid.items() if cell != (2, 2)}
    guess = predict(inner, (2, 2))
    assert guess is not None and np.allclose(guess, grid[2, 2], atol=1e-6)
    assert predict({(0, 0): np.zeros(2)}, (1, 0)) is None and predict(grid, (40, 40)) is None


def test_the_spacing_is_that_of_adjacent_corners() -> None:
    grid = sheet(scale=0.5).grid
    assert spacing(grid, (2, 2)) == pytest.approx(12.0) and spacing(grid, (-1, 0)) == pytest.approx(12.0)
    assert spacing({(0, 0): np.zeros(2)}, (0, 0)) == 0


def test_axes_turn_clockwise() -> None:
    grid = sheet().grid
    swapped = {(j, i): pixel for (i, j), pixel in grid.items()}
    assert with_clockwise_axes(grid) is grid and with_clockwise_axes(swapped).keys() == grid.keys()


def test_corners_are_refined_unless_their_window_leaves_the_image() -> None:
    seen = sheet()
    refined = refine_subpixel(seen.grey, np.vstack([seen.pixels + 0.8, [[1.0, 1.0]]]), np.full(COUNT + 1, 24.0))
    assert np.linalg.norm(refined[:-1] - seen.pixels, axis=1).max() < 0.3 and refined[-1].tolist() == [1.0, 1.0]
