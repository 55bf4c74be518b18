"""Layers of log-odds of the obstacle grid, and what they say of its cells: unknown, free or taken."""

from __future__ import annotations

from typing import Final

import cv2
import numpy as np
from numpy.typing import NDArray

from omnid.core.obstacles.cell_kernels import (
    ABOVE,
    BELOW,
    FLOOR,
    FLOOR_LOW,
    FLOOR_PRIOR,
    SURFACE,
    SURFACE_PRIOR,
    VISIBLE_PRIOR,
)
from omnid.core.obstacles.state_kernels import free_cells

Floats = NDArray[np.float32]
Bytes = NDArray[np.uint8]

FLOORS: Final = slice(FLOOR, SURFACE)
# Log-odds of the layers where nothing was seen: steps up and down are even, because nothing speaks for either.
PRIOR: Final = (FLOOR_PRIOR, 0.0, 0.0, SURFACE_PRIOR, VISIBLE_PRIOR)
WIDE_CELLS: Final = 3  # Side of the mean that shows floor or a low object, because single cells are noisy.
# The same of an edge: a hole into which a base falls is wide. With 3, by trial, bases stood before joints of tiles.
EDGE_CELLS: Final = 5


def cells_of(odds: Floats, shown: Floats) -> Bytes:
    """Return the cells (H, W) by their log-odds (5, H, W): 0 unknown, 1 free (by all layers), 2 taken.

    shown (H, W): mean surface of single pairs.
    """
    floor, cells = mean_over(odds[FLOOR], WIDE_CELLS), np.empty(shown.shape, np.uint8)
    free_cells(odds, shown, floor, level_odds(odds), cells)
    return cells


def level_odds(odds: Floats) -> Floats:
    """Return the least log-odds (H, W) against steps up and down, which are wider than a cell.

    An edge is remembered by lower log-odds than FLOOR_LOW, but a few such cells are not as wide as one.
    """
    return np.minimum(mean_over(odds[ABOVE], WIDE_CELLS), mean_over(np.maximum(odds[BELOW], FLOOR_LOW), EDGE_CELLS))


def mean_over(odds: Floats, cells: int) -> Floats:
    """Return the mean (H, W) of log-odds over a patch with a side of so many cells."""
    return np.asarray(cv2.blur(odds, (cells, cells)), np.float32)
