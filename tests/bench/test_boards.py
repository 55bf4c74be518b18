"""A few of the hard renderings; `python -m tests.bench.boards` has more and compares with OpenCV's detectors."""

from __future__ import annotations

import numpy as np
import pytest

from calib.boards.board import Board
from calib.boards.board_finder import find_board
from tests.bench.boards import (
    DETECTORS,
    HardBoard,
    classify_detection,
    corner_orders,
    count,
    meets_requirement,
    render_hard_board,
    render_near_board,
)

# Small images of every kind of mirror and of many walls.
NUMBERS = (2, 14, 16, 23, 24, 25)


@pytest.mark.slow
def test_finds_more_boards_than_opencv_and_no_wrong_one() -> None:
    shots = [render_hard_board(7, number) for number in NUMBERS]
    sums = {name: count(shots, detect, empty=name == "omnid") for name, detect in DETECTORS.items()}
    assert meets_requirement(sums, len(shots)), sums


@pytest.mark.slow
@pytest.mark.parametrize("number", [3, 4, 5, 13, 17, 25, 27])
def test_finds_no_board_in_windows_bricks_stripes_and_floors(number: int) -> None:
    image = render_hard_board(7, number).empty
    assert [board for board in ((4, 3), (5, 4), (3, 3)) if find_board(image, Board(*board, 0.03)).view] == []


@pytest.mark.slow
@pytest.mark.parametrize(("number", "worst_px"), [(36, 0.7), (48, 0.7)])
def test_finds_the_board_and_not_a_torn_floor_and_drops_corners_at_a_shadow(number: int, worst_px: float) -> None:
    rendered = render_hard_board(1, number)
    view = find_board(rendered.image, rendered.board).view
    assert view is not None and find_board(rendered.empty, rendered.board).view is None
    truth = rendered.corners.reshape(rendered.board.rows, rendered.board.columns, 2)
    errors = [
        float(np.nanmax(np.linalg.norm(view.pixels - order, axis=1))) for order in corner_orders(truth, rendered.board)
    ]
    assert min(errors) < worst_px


def test_classifies_a_board_shifted_by_a_square_as_wrong() -> None:
    x, y = np.meshgrid(10.0 * np.arange(5), 10.0 * np.arange(4))
    corners, image = np.column_stack([x.ravel(), y.ravel()]), np.zeros((9, 9), np.uint8)
    rendered = HardBoard("", Board(5, 4, 0.03), image, image, corners)
    detections = (None, corners[::-1] + 0.5, corners + np.array([10.0, 0.0]))
    assert [classify_detection(found, rendered) for found in detections] == ["missed", "found", "wrong"]


@pytest.mark.slow
@pytest.mark.parametrize("number", [14, 24])
def test_finds_near_boards_whose_outer_squares_a_frame_covers(number: int) -> None:
    """The plain detector of OpenCV misses these boards, and no ring of squares surrounds their corners."""
    rendered = render_near_board(1, number)
    assert classify_detection(DETECTORS["omnid"](rendered.image, rendered.board), rendered) == "found"
    assert DETECTORS["omnid"](rendered.empty, rendered.board) is None
    assert DETECTORS["findChessboardCorners"](rendered.image, rendered.board) is None
