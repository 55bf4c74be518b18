"""Compiled loops that tell free, taken and unknown cells of the obstacle grid by their log-odds.

Flags have a margin of one cell on each side, which is 0, so that all cells have neighbours.
"""

from __future__ import annotations

from typing import Final

import numpy as np
from numpy.typing import NDArray

from omnid.core.compiled import compiled, inner
from omnid.core.obstacles.cell_kernels import FLOOR, NOTHING, SURFACE, TAKEN_ODDS, VISIBLE, Bytes, Floats

Numbers = NDArray[np.int64]

# Labels of flags, and of cells (unknown, free, taken), so that they fit a byte.
NO, YES, TAKEN = np.uint8(0), np.uint8(1), np.uint8(2)

# Log-odds of the floor from which a cell is free, so that it takes three pairs of the usual evidence, 1 each, from -1.
FREE_ODDS: Final = np.float32(1.5)
VISIBLE_ODDS: Final = np.float32(0.0)  # Log-odds of visible floor above which a cell is free.
# Most log-odds of a surface in a free cell: 3 %. With -4.5, by trial, a base stopped in a free corridor.
CLEAR_ODDS: Final = np.float32(-3.5)
# Largest mean in a free cell. With 0.06, by trial, more tables 0.8 to 1.25 m away were free, and with 0.042 a base
# stood 1.7 m before a shelf.
FREE_SHOWN: Final = np.float32(0.05)
# Unknown cells that are so few, with floor around, because what is tall hides floor behind it, and a low box is larger.
SPECK_CELLS: Final = 4


@inner
def judge(
    floor: Floats,
    surface: Floats,
    visible: Floats,
    shown: Floats,
    mean_floor: Floats,
    level: Floats,
    unknown: Bytes,
) -> None:
    """Write 1 where cells (W,) are neither free nor taken, each by itself."""
    for j in range(len(floor)):
        is_suspect = (surface[j] > CLEAR_ODDS) | (shown[j] > FREE_SHOWN)
        # Single cells are noisy: one that is more likely floor than not is so by its neighbours, too.
        is_floor = (floor[j] > FREE_ODDS) | ((floor[j] > NOTHING) & (mean_floor[j] > FREE_ODDS))
        is_free = is_floor & (level[j] > FREE_ODDS) & (visible[j] > VISIBLE_ODDS) & (not is_suspect)
        unknown[j] = NO if is_free | (surface[j] > TAKEN_ODDS) else YES


@inner
def count_around(flags: Bytes, i: int, count: Bytes) -> None:
    """Write the number of flags among the nine about each cell (W,) of row i of flags (H + 2, W + 2)."""
    above, mine, below = flags[i], flags[i + 1], flags[i + 2]
    for j in range(len(count)):
        left, middle = above[j] + mine[j] + below[j], above[j + 1] + mine[j + 1] + below[j + 1]
        count[j] = np.uint8(left + middle + above[j + 2] + mine[j + 2] + below[j + 2])


@inner
def patch(flags: Bytes, i: int, j: int, found: Numbers) -> int:
    """Write the places (N, 2) of the flags that are connected to i, j; return how many, N where they are more, too."""
    found[0, 0], found[0, 1] = i, j
    count, n = 1, 0
    while n < count:
        for place in range(9):
            y, x = found[n, 0] + place // 3 - 1, found[n, 1] + place % 3 - 1
            is_new = flags[y, x] != NO
            for m in range(count):
                is_new &= found[m, 0] != y or found[m, 1] != x
            if is_new:
                found[count, 0], found[count, 1] = y, x
                count += 1
                if count == len(found):
                    return count
        n += 1
    return count


@inner
def remove_specks(odds: Floats, shown: Floats, unknown: Bytes) -> None:
    """Clear the flags (H + 2, W + 2) of unknown patches of few cells, unless something may stand in one of them."""
    height, width = shown.shape
    count, found = np.empty(width, np.uint8), np.empty((SPECK_CELLS + 1, 2), np.int64)
    for i in range(height):
        count_around(unknown, i, count)
        for j in range(width):
            if count[j] > SPECK_CELLS or unknown[i + 1, j + 1] == NO:
                continue
            cells = patch(unknown, i + 1, j + 1, found)
            hides = cells > SPECK_CELLS
            for n in range(cells):
                y, x = found[n, 0] - 1, found[n, 1] - 1
                hides |= odds[SURFACE, y, x] > CLEAR_ODDS or shown[y, x] > FREE_SHOWN
                hides |= odds[VISIBLE, y, x] <= VISIBLE_ODDS
            if not hides:
                for n in range(cells):
                    unknown[found[n, 0], found[n, 1]] = NO


@compiled("(f4[:, :, ::1], f4[:, ::1], f4[:, ::1], f4[:, ::1], u1[:, ::1])", writes=("cells",))
def free_cells(odds: Floats, shown: Floats, mean_floor: Floats, level: Floats, cells: Bytes) -> None:
    """Write the cells (H, W): 0 unknown, 1 free, 2 taken.

    odds (5, H, W): of all layers; shown (H, W): mean surface of single pairs; mean_floor (H, W): mean of the floor
    around a cell; level (H, W): log-odds against steps.
    """
    height, width = cells.shape
    unknown, steps = np.zeros((height + 2, width + 2), np.uint8), np.zeros((height + 2, width + 2), np.uint8)
    inside, count = slice(1, width + 1), np.empty(width, np.uint8)
    for i in range(height):
        row = unknown[i + 1, inside]
        judge(odds[FLOOR, i], odds[SURFACE, i], odds[VISIBLE, i], shown[i], mean_floor[i], level[i], row)
    # Specks are noise unless something may stand there.
    remove_specks(odds, shown, unknown)
    # Steps are seen by several directions together, of which those at a corner show half floor.
    for i in range(height):
        row, step, against = unknown[i + 1, inside], steps[i + 1, inside], level[i]
        for j in range(width):
            step[j] = row[j] if against[j] < NOTHING else NO
    for i in range(height):
        count_around(steps, i, count)
        row, surface, into = unknown[i + 1, inside], odds[SURFACE, i], cells[i]
        for j in range(width):
            is_free = (row[j] == NO) & (count[j] == NO)
            into[j] = TAKEN if surface[j] > TAKEN_ODDS else (YES if is_free else NO)
