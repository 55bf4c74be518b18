"""Layers of log-odds, and what they say of cells."""

from __future__ import annotations

import numpy as np
import pytest

from omnid.core.obstacles.cell_kernels import BELOW, EDGE_LOW, FLOOR, LIMIT
from omnid.core.obstacles.grid_layers import PRIOR, cells_of

SIDE = 40
MIDDLE = slice(15, 25)


def state(wide: int) -> np.ndarray:
    """Return the cells of a floor that falls, as it seems, in a square of so many cells in the middle."""
    odds = np.empty((len(PRIOR), SIDE, SIDE), np.float32)
    odds[:] = np.array(PRIOR, np.float32)[:, None, None]
    odds[FLOOR:3] = LIMIT
    first = SIDE // 2 - wide // 2
    odds[BELOW, first : first + wide, first : first + wide] = EDGE_LOW
    return cells_of(odds, np.zeros((SIDE, SIDE), np.float32))


@pytest.mark.parametrize(("wide", "unknown"), [(3, 0), (5, 20)])
def test_an_edge_is_wider_than_a_few_cells(wide: int, unknown: int) -> None:
    """A hole into which a base falls is wide: noise in cells of 15 cm is none, however surely they seem to fall."""
    assert (state(wide)[MIDDLE, MIDDLE] == 0).sum() >= unknown and ((state(wide) == 1).all() == (wide == 3))
