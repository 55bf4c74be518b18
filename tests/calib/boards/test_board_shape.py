"""Local mapping from board to image about a corner, and checks of a board's regularity, pattern and outline."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from calib.boards.board_shape import outline


def chequers(columns: int, rows: int, margin_px: int) -> NDArray[np.uint8]:
    """Return squares of 12 px with a light margin."""
    squares = np.kron(np.indices((rows, columns)).sum(axis=0) % 2, np.ones((12, 12))) * 150 + 40
    return np.pad(squares, margin_px, constant_values=190).astype(np.uint8)


@pytest.mark.parametrize(
    ("columns", "rows", "margin_px", "whole"),
    [(7, 6, 40, True), (9, 6, 40, False), (7, 9, 40, False), (20, 20, 0, False), (6, 5, 40, False)],
)
def test_distinguishes_a_board_from_a_chequered_floor(columns: int, rows: int, margin_px: int, whole: bool) -> None:
    """Check 6x5 corners in a board of that size, in larger boards, in a floor, and in a smaller board."""
    corner = 12.0 * (1 + (columns > 8) + (rows > 8)) + margin_px - 0.5
    grid = np.stack(np.meshgrid(corner + 12 * np.arange(6), corner + 12 * np.arange(5)), axis=-1)
    assert outline(chequers(columns, rows, margin_px).astype(np.float32), grid)[0] is whole
