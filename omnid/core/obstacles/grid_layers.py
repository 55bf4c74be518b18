"""Layers of log-odds of the obstacle grid, and what they say of its cells: unknown, free or taken."""

from __future__ import annotations

from typing import Final

import cv2
import numpy as np
from numpy.typing import NDArray

from omnid.core.obstacles.state_kernels import free_cells

Floats = NDArray[np.float32]
Bytes = NDArray[np.uint8]

# Layers: floor against upright surfaces, against planes just above and below it; surface; visible floor against floor
# that something plain hides.
FLOOR, ABOVE, BELOW, SURFACE, VISIBLE = 0, 1, 2, 3, 4
FLOORS: Final = slice(FLOOR, SURFACE)
PRIOR: Final = (-1.0, 0.0, 0.0, -6.0, 3.0)  # log-odds where nothing was seen
VISIBLE_ODDS: Final = 0.0  # Log-odds of visible floor above which a cell is free.
FREE_ODDS: Final = 1.5  # Log-odds of the floor from which a cell is free.
TAKEN_ODDS: Final = 0.0  # Log-odds of a surface from which a cell is occupied.
CLEAR_ODDS: Final = -3.5  # Most log-odds of a surface in a free cell: 3 %. With -4.5 a base stopped in a free corridor.
FREE_SHOWN: Final = 0.1  # largest mean in a free cell
# Unknown cells that are so few, with floor around: what is tall hides floor behind it, and a low box is larger.
SPECK_CELLS: Final = 4
WIDE_CELLS: Final = 3  # Side of the mean that shows floor or a low object, because single cells are noisy.
# The same of an edge: a hole into which a base falls is wide. With 3, by trial, bases stood before joints of tiles.
EDGE_CELLS: Final = 5


def cells_of(odds: Floats, shown: Floats) -> Bytes:
    """Return the cells (H, W) by their log-odds (5, H, W): 0 unknown, 1 free (by all layers), 2 taken.

    shown (H, W): mean surface of single pairs.
    """
    floor, cells = mean_over(odds[FLOOR], WIDE_CELLS), np.empty(shown.shape, np.uint8)
    limits = FREE_ODDS, VISIBLE_ODDS, TAKEN_ODDS, CLEAR_ODDS, FREE_SHOWN
    free_cells(odds, shown, floor, level_odds(odds), limits, SPECK_CELLS, cells)
    return cells


def level_odds(odds: Floats) -> Floats:
    """Return the least log-odds (H, W) against steps up and down, which are wider than a cell."""
    return np.minimum(mean_over(odds[ABOVE], WIDE_CELLS), mean_over(odds[BELOW], EDGE_CELLS))


def mean_over(odds: Floats, cells: int) -> Floats:
    """Return the mean (H, W) of log-odds over a patch with a side of so many cells."""
    return np.asarray(cv2.blur(odds, (cells, cells)), np.float32)
