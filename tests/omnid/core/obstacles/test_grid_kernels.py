"""Evidence of directions and disparities, gathered by cells."""

from __future__ import annotations

from typing import Final

import numpy as np
import pytest

from omnid.core.obstacles.grid_kernels import gather
from omnid.core.obstacles.pair_views import DIRECTIONS

AT_1M: Final = 8.0  # disparity
CELL_M: Final = 0.1
HALF: Final = 30  # cells on either side of the origin


def test_a_cell_nearer_than_the_last_disparity_has_no_evidence() -> None:
    """It is not that of the last one: a low robot sees the floor up to there, and would see it below itself."""
    bins = 8  # from 1 m on
    cells = np.empty((5, 2 * HALF + 1, 2 * HALF + 1), np.float32)
    shown = np.full((bins, DIRECTIONS), 2.0, np.float32)
    first = np.array([-HALF * CELL_M, -HALF * CELL_M, 1.0, 0.0, 0.0, 0.0])
    gather(shown, shown, np.full((2, *shown.shape), 2.0, np.float32), first, AT_1M, CELL_M, 2.9, 0.035, cells)
    y, x = np.mgrid[-HALF : HALF + 1, -HALF : HALF + 1] * CELL_M
    range_m = np.hypot(x, y)
    near, in_view = range_m < 0.94, (range_m > 1.06) & (range_m < 2.8)
    assert np.isnan(cells[0][near]).all() and np.isnan(cells[4][near]).all() and not cells[1:4, near].any()
    assert (cells[0][in_view] > 0).all() and np.allclose(cells[1:4, in_view], 2.0)


def gathered(floor: np.ndarray, surface: np.ndarray, lean_m: tuple[float, float] = (0.0, 0.0)) -> np.ndarray:
    """Return the evidence of cells (5, rows of y, columns of x)."""
    cells = np.empty((5, 2 * HALF + 1, 2 * HALF + 1), np.float32)
    origin = np.array([-HALF * CELL_M, -HALF * CELL_M, 1.0, 0.0, *lean_m])
    level = np.zeros((2, *floor.shape), np.float32)
    gather(floor, surface, level, origin, 80.0, CELL_M, 2.9, 0.035, cells)
    return cells


def test_a_cell_that_one_direction_does_not_show_is_not_shown_on_either_side() -> None:
    """The sector about the axis x is not seen; what is left of it is as what is right of it."""
    floor = np.full((80, DIRECTIONS), 2.0, np.float32)
    floor[:, 3 * DIRECTIONS // 8 : 5 * DIRECTIONS // 8] = np.nan
    shown = np.isfinite(gathered(floor, np.zeros_like(floor))[0])
    y, x = np.mgrid[-HALF : HALF + 1, -HALF : HALF + 1]
    left, right = (int(shown[side].sum()) for side in (y > 0, y < 0))
    assert left == pytest.approx(right, abs=4) and not shown[np.abs(y) < x].any()


def test_a_surface_of_a_leaning_rig_counts_at_its_foot_and_where_it_appears() -> None:
    """Ahead it appears farther than its foot by up to 0.3 m, behind nearer."""
    surface = np.zeros((80, DIRECTIONS), np.float32)
    surface[40] = 9.0  # 2 m
    upright, leaning = (gathered(surface, surface, lean)[3][HALF] > 3.0 for lean in ((0.0, 0.0), (-0.3, 0.0)))
    assert np.flatnonzero(upright).tolist() == [HALF - 20, HALF + 20]
    assert np.flatnonzero(leaning).tolist() == [*range(HALF - 23, HALF - 19), *range(HALF + 17, HALF + 21)]
