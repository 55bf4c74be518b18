"""A few of the hard renderings: `python -m tests.benchmark.boards` has more, and OpenCV's detectors beside them."""

from __future__ import annotations

import numpy as np
import pytest

from calib.boards.board import Board
from calib.boards.board_finder import find_board
from tests.benchmark.boards import DETECTORS, count, enough, judged
from tests.benchmark.boards_rendered import Hard, hard

NUMBERS = (2, 14, 16, 23, 24, 25)  # small images, one of each kind of mirror and of many walls


@pytest.mark.slow
def test_more_boards_than_opencv_finds_and_none_that_is_wrong() -> None:
    shots = [hard(7, number) for number in NUMBERS]
    sums = {name: count(shots, detect, empty=name == "omnid") for name, detect in DETECTORS.items()}
    assert enough(sums, len(shots)), sums


@pytest.mark.slow
@pytest.mark.parametrize("number", [3, 4, 5, 13, 17, 25, 27])
def test_windows_bricks_stripes_and_floors_are_no_boards(number: int) -> None:
    image = hard(7, number).empty
    assert [board for board in ((4, 3), (5, 4), (3, 3)) if find_board(image, Board(*board, 0.03)).view] == []


def test_a_board_a_square_off_is_wrong() -> None:
    x, y = np.meshgrid(10.0 * np.arange(5), 10.0 * np.arange(4))
    corners, image = np.column_stack([x.ravel(), y.ravel()]), np.zeros((9, 9), np.uint8)
    shot = Hard("", Board(5, 4, 0.03), image, image, corners)
    assert [judged(found, shot) for found in (None, corners[::-1] + 0.5, corners + np.array([10.0, 0.0]))] == [
        "missed", "found", "wrong"]
