"""Boards: corners in order, sizes that no board has, and the shape of a print."""

from __future__ import annotations

import numpy as np
import pytest

from calib.boards.board import Board
from calib.boards.marker_board import AprilGrid, CharucoBoard, MarkerBoard
from calib.boards.print_shape import AS_DRAWN, PrintShape
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


@pytest.mark.parametrize(
    ("make", "words"),
    [
        (lambda: CharucoBoard(6, 5, 0.05, 0.06, "4X4_50"), "markers of 0.3 to 0.95 of the squares' side, found 60 mm"),
        (
            lambda: CharucoBoard(6, 5, 0.05, 0.03, "4X5_50"),
            "expected a dictionary of markers .*4X4_50.* found '4X5_50'",
        ),
        (lambda: CharucoBoard(20, 20, 0.05, 0.03, "4X4_50"), "4X4_50 has 50 markers, and this board needs 220"),
        (lambda: CharucoBoard(1, 5, 0.05, 0.03, "4X4_50"), "expected 2 to 60 inner corners"),
        (lambda: AprilGrid(6, 6, float("nan"), 0.3), "tags of 0.1 mm to 10 m"),
        (lambda: AprilGrid(6, 6, 0.08, 24.0), "like Kalibr's tagSpacing, found 24"),
        (lambda: AprilGrid(30, 30, 0.08, 0.3), "APRILTAG_36h11 has 587 markers, and this board needs 900"),
    ],
)
def test_refuses_impossible_boards(make: type[MarkerBoard], words: str) -> None:
    with pytest.raises(CalibError, match=words):
        make()


BOARD = Board(7, 6, 0.03)
BENT = PrintShape((2e-3, -1e-3, 0.5e-3, 3e-3))


def test_a_bent_sheet_keeps_its_lengths() -> None:
    fine = np.column_stack([np.linspace(-0.03, 0.21, 2000), np.full(2000, 0.04), np.zeros(2000)])
    bent = PrintShape((3e-3, 0.0, 0.0, 0.0)).points_of(BOARD.points, fine)
    length = np.linalg.norm(np.diff(bent, axis=0), axis=1).sum()
    assert length == pytest.approx(0.24, rel=2e-6)


def test_the_sag_is_that_of_the_corners_above_a_plane() -> None:
    assert PrintShape((0.8e-3, 0.0, 0.0, 0.0)).sag_m(BOARD.points) == pytest.approx(0.8e-3, rel=0.01)
    assert PrintShape((0.0, 0.0, 0.4e-3, 0.0)).sag_m(BOARD.points) == pytest.approx(0.8e-3)
    assert AS_DRAWN.sag_m(BOARD.points) == 0.0
