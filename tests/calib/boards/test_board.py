"""Checkerboards: their corners in order, and sizes that no board has."""

from __future__ import annotations

import numpy as np
import pytest

from calib.boards.board import Board
from calib.errors import CalibError


@pytest.mark.parametrize(
    ("columns", "rows", "square_m"), [(2, 5, 0.03), (6, 61, 0.03), (6, 5, 0.0), (6, 5, -0.03), (6, 5, float("nan"))]
)
def test_refuses_an_impossible_board(columns: int, rows: int, square_m: float) -> None:
    with pytest.raises(CalibError, match="board: expected"):
        Board(columns, rows, square_m)


def test_points_are_row_by_row_from_the_first_inner_corner() -> None:
    points = Board(4, 3, 0.05).points
    assert points.shape == (12, 3) and points[0].tolist() == [0, 0, 0] and not points[:, 2].any()
    assert np.allclose(points[5], (0.05, 0.05, 0)) and np.allclose(points[-1], (0.15, 0.1, 0))
