"""The board's window in a grid, and the order of its corners."""

from __future__ import annotations

import numpy as np
import pytest

from calib.boards.board import Board
from calib.boards.board_order import (
    array_to_grid,
    grid_to_array,
    largest_rectangle,
    orient_corners,
    select_board_window,
)
from calib.boards.corner_grid import Grid
from tests.calib.boards.sheets import BOARD, sheet


def regular(columns: int, rows: int, *hidden: tuple[int, int]) -> Grid:
    cells = {(i, j) for i in range(columns) for j in range(rows)} - {*hidden}
    return {(i, j): np.array([10.0 * i, 10.0 * j]) for i, j in cells}


def test_a_grid_is_an_array_with_a_border_and_back() -> None:
    grid = regular(4, 3, (1, 1))
    corners = grid_to_array(grid)
    assert corners.shape == (7, 8, 2) and np.isnan(corners[:2]).all() and np.isnan(corners[3, 3]).all()
    assert array_to_grid(corners[2:-2, 2:-2]).keys() == grid.keys()


@pytest.mark.parametrize(("columns", "rows"), [(6, 5), (5, 6)])
def test_a_board_is_found_upright_and_on_its_side(columns: int, rows: int) -> None:
    found = select_board_window(regular(columns, rows, (2, 2)), BOARD)
    assert found is not None and found.shape == (BOARD.rows, BOARD.columns, 2)
    assert np.isnan(found[..., 0]).sum() == 1


@pytest.mark.parametrize(
    "grid",
    [regular(7, 5), regular(6, 6), regular(5, 5), regular(6, 5, (0, 0), (1, 0), (2, 0)), {(0, 0): np.zeros(2)}],
    ids=["wider", "higher", "smaller", "half a border", "one corner"],
)
def test_a_grid_of_another_size_has_no_board(grid: Grid) -> None:
    assert select_board_window(grid, BOARD) is None


def test_the_largest_rectangle_leaves_out_ragged_borders() -> None:
    assert largest_rectangle(regular(6, 5)) == (6, 5)
    assert largest_rectangle(regular(6, 5) | {(6, 1): np.zeros(2), (2, 5): np.zeros(2)}) == (6, 5)
    assert largest_rectangle(regular(6, 5, (0, 2))) == (5, 5)


@pytest.mark.parametrize("turns", [0, 1, 2, 3])
def test_the_first_square_is_dark_whichever_way_the_corners_come(turns: int) -> None:
    seen = sheet()
    assert np.array_equal(orient_corners(seen.grey, np.rot90(seen.corners, turns), BOARD), seen.corners)


def test_of_several_orders_the_first_corner_is_the_upper_left_one() -> None:
    corners = sheet().corners[:3, :3]
    square, grey = Board(3, 3, 0.03), np.full((300, 340), 90, np.float32)
    found = [orient_corners(grey, np.rot90(corners, turns), square)[0, 0].sum() for turns in range(4)]
    assert found == [min(corners[j, i].sum() for j in (0, -1) for i in (0, -1))] * 4
