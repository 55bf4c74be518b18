"""Sizes that no board has are refused."""

from __future__ import annotations

import pytest

from calib.boards.board import Board
from calib.boards.marker_board import AprilGrid, CharucoBoard, MarkerBoard
from calib.errors import CalibError


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
