"""Evidence of directions and disparities, gathered by cells."""

from __future__ import annotations

from typing import Final

import numpy as np

from omnid.core.obstacles.column import DIRECTIONS
from omnid.core.obstacles.grid_kernels import gather

AT_1M: Final = 8.0  # disparity
CELL_M: Final = 0.1
HALF: Final = 30  # cells on either side of the origin


def test_a_cell_nearer_than_the_last_disparity_has_no_evidence() -> None:
    """It is not that of the last one: a low robot sees the floor up to there, and would see it below itself."""
    bins = 8  # from 1 m on
    cells = np.empty((5, 2 * HALF + 1, 2 * HALF + 1), np.float32)
    shown = np.full((bins, DIRECTIONS), 2.0, np.float32)
    first = np.array([-HALF * CELL_M, -HALF * CELL_M, 1.0, 0.0])
    gather(shown, shown, np.full((2, *shown.shape), 2.0, np.float32), first, AT_1M, CELL_M, 2.9, 0.035, cells)
    y, x = np.mgrid[-HALF : HALF + 1, -HALF : HALF + 1] * CELL_M
    range_m = np.hypot(x, y)
    near, in_view = range_m < 0.94, (range_m > 1.06) & (range_m < 2.8)
    assert np.isnan(cells[0][near]).all() and np.isnan(cells[4][near]).all() and not cells[1:4, near].any()
    assert (cells[0][in_view] > 0).all() and np.allclose(cells[1:4, in_view], 2.0)
