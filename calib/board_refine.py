"""Corners to a few hundredths of a pixel: each is looked at in its own square-on view of the board.

Edges in a mirror are bent and squares sheared; a window that is straight in the picture then pulls the corner aside.
The neighbours tell, to second order, how board and picture map, so that a window can be cut out along the board.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from calib.board_corners import Grey, sample
from calib.board_shape import local_mapping, terms
from calib.camera import Array

# The window reaches so far into the four squares, near to whose far ends other edges begin, and no further than what
# the picture's blur still bends.
REACH, REACH_PX = 0.42, 8
ROUNDS = 4
STILL_PX = 2e-3
# Further than this part of a square from where it started, a corner has run away and is put back.
MAX_MOVE = 0.3


def refine(image: NDArray[np.uint8], corners: Array) -> Array:
    """Corners (rows, columns, 2) [px] moved onto the picture's; those that cannot be told stay where they are."""
    grey, refined = image.astype(np.float32), corners.copy()
    for _ in range(ROUNDS):
        moved = refined.copy()
        for j, i in np.argwhere(np.isfinite(corners[..., 0])):
            mapping = local_mapping(refined, int(j), int(i))
            if mapping is not None:
                moved[j, i] = _recentred(grey, mapping, corners[j, i])
        step = np.nanmax(np.linalg.norm(moved - refined, axis=2))
        refined = moved
        if step < STILL_PX:
            break
    return refined


def _recentred(grey: Grey, mapping: Array, start: Array) -> Array:
    """The corner's pixel (2,) as the window shows it."""
    size = float(np.sqrt(abs(np.linalg.det(mapping[1:3]))))  # pixels per square
    reach = min(REACH, REACH_PX / max(size, 1e-6))
    side = int(np.clip(np.ceil(2 * reach * size), 5, 2 * REACH_PX)) // 2 * 2 + 1
    x, y = np.meshgrid(*2 * [np.linspace(-reach, reach, side)])
    shift = _saddle(sample(grey, terms(x, y) @ mapping), x, y)
    moved = terms(shift[0], shift[1]) @ mapping
    return moved if np.linalg.norm(moved - start) < MAX_MOVE * size + 0.3 else start


def _saddle(window: Array, x: Array, y: Array) -> Array:
    """Where (2,) the second-order surface through a window at x, y is level, 0 where it has no saddle.

    Lucchese and Mitra 2002. Halos and blooming, which push all four edges about, leave that point where it is: on real
    pictures it fits cameras better than where the edges' gradients cross.
    """
    reach = float(x.max())
    weight = np.exp(-(x * x + y * y) / (2 * (0.6 * reach) ** 2)).ravel()
    A = terms(x.ravel(), y.ravel()) * weight[:, None]
    _, gx, gy, xx, xy, yy = np.linalg.lstsq(A, window.ravel() * weight, rcond=None)[0]
    determinant = 4 * xx * yy - xy * xy
    if determinant >= 0:
        return np.zeros(2)
    shift = np.array([xy * gy - 2 * yy * gx, xy * gx - 2 * xx * gy]) / determinant
    return np.asarray(np.clip(shift, -reach, reach))
