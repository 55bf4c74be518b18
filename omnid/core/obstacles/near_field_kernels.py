"""Compiled loops along the directions around the viewpoint, cell by cell, from the cell next to it on.

Directions (N, 2) are unit vectors; the viewpoint (2,) and ways are in cells. Cells out of the square are left out.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from omnid.core.compiled import compiled

Floats = NDArray[np.float32]
Doubles = NDArray[np.float64]
Bytes = NDArray[np.uint8]
Numbers = NDArray[np.int32]


@compiled("(f8[::1], f8[:, ::1], i8, f4[::1], f4[:, ::1])", writes=("lost",))
def lose_before(eye: Doubles, directions: Doubles, nearest: int, near: Floats, lost: Floats) -> None:
    """Write to the cells of `lost` (H, W) nearer than `nearest` the most of the values (N,) of their directions."""
    height, width = lost.shape
    for turn in range(2):
        for n in range(len(directions)):
            for step in range(1, nearest):
                i, j = math.floor(eye[1] + step * directions[n, 1]), math.floor(eye[0] + step * directions[n, 0])
                if 0 <= i < height and 0 <= j < width:
                    lost[i, j] = max(lost[i, j], near[n]) if turn else np.float32(-np.inf)


@compiled(
    "(f4[:, ::1], f4[:, ::1], f4[:, ::1], f8[::1], f8[:, ::1], i8[::1], f4[::1], u1[::1], i4[::1])",
    writes=("floor_behind", "clear"),
)
def view_past(
    floor: Floats,
    surface: Floats,
    evidence: Floats,
    eye: Doubles,
    directions: Doubles,
    ways: NDArray[np.int64],
    least: Floats,
    floor_behind: Bytes,
    clear: Numbers,
) -> None:
    """Write, along directions (N,), 1 where floor is watched behind the nearest in view, and the number of cells before
    the first watched surface, that of all where there is none.

    floor, surface (H, W): log-odds; evidence (H, W): by which cells are watched. ways (2,): number of the first cell
    that counts as behind, and of the last one. least (3,): evidence and log-odds above which a cell is watched, floor,
    a surface.
    """
    height, width = floor.shape
    for n in range(len(directions)):
        floor_behind[n], clear[n] = 0, ways[1]
        for step in range(1, ways[1] + 1):
            i, j = math.floor(eye[1] + step * directions[n, 1]), math.floor(eye[0] + step * directions[n, 0])
            if i < 0 or j < 0 or i >= height or j >= width or not evidence[i, j] > least[0]:
                continue
            if step >= ways[0] and floor[i, j] > least[1]:
                floor_behind[n] = 1
            if surface[i, j] > least[2] and clear[n] == ways[1]:
                clear[n] = step - 1


@compiled("(f8[::1], f8[:, ::1], i4[::1], u1[:, ::1])", writes=("cells",))
def mark(eye: Doubles, directions: Doubles, ways: Numbers, cells: Bytes) -> None:
    """Write 1 to the first ways (N,) cells (H, W) along each direction."""
    height, width = cells.shape
    for n in range(len(directions)):
        for step in range(1, ways[n] + 1):
            i, j = math.floor(eye[1] + step * directions[n, 1]), math.floor(eye[0] + step * directions[n, 0])
            if 0 <= i < height and 0 <= j < width:
                cells[i, j] = 1
