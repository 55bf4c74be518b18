"""Compiled loops that tell free, taken and unknown cells of the obstacle grid by their log-odds.

Flags have a margin of one cell on each side, which is 0, so that all cells have neighbours.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from omnid.core.compiled import compiled, inner
from omnid.core.obstacles.cell_kernels import FLOOR, NOTHING, SURFACE, VISIBLE, Bytes, Floats

Numbers = NDArray[np.int64]
Limits = tuple[float, float, float, float, float]

NO, YES, TAKEN = np.uint8(0), np.uint8(1), np.uint8(2)  # of flags, and of cells: unknown, free, taken


@inner
def judge(
    floor: Floats,
    surface: Floats,
    visible: Floats,
    shown: Floats,
    mean_floor: Floats,
    level: Floats,
    limits: Limits,
    unknown: Bytes,
) -> None:
    """Write 1 where cells (W,) are neither free nor taken, each by itself."""
    free_odds, visible_odds, taken_odds, clear_odds, free_shown = limits
    for j in range(len(floor)):
        is_suspect = (surface[j] > clear_odds) | (shown[j] > free_shown)
        # Single cells are noisy: one that is more likely floor than not is so by its neighbours, too.
        is_floor = (floor[j] > free_odds) | ((floor[j] > NOTHING) & (mean_floor[j] > free_odds))
        is_free = is_floor & (level[j] > free_odds) & (visible[j] > visible_odds) & (not is_suspect)
        unknown[j] = NO if is_free | (surface[j] > taken_odds) else YES


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
def remove_specks(odds: Floats, shown: Floats, limits: Limits, most: int, unknown: Bytes) -> None:
    """Clear the flags (H + 2, W + 2) of unknown patches of so few cells, unless something may stand in one of them."""
    height, width = shown.shape
    count, found = np.empty(width, np.uint8), np.empty((most + 1, 2), np.int64)
    for i in range(height):
        count_around(unknown, i, count)
        for j in range(width):
            if count[j] > most or unknown[i + 1, j + 1] == NO:
                continue
            cells = patch(unknown, i + 1, j + 1, found)
            hides = cells > most
            for n in range(cells):
                y, x = found[n, 0] - 1, found[n, 1] - 1
                hides |= odds[SURFACE, y, x] > limits[3] or shown[y, x] > limits[4] or odds[VISIBLE, y, x] <= limits[1]
            if not hides:
                for n in range(cells):
                    unknown[found[n, 0], found[n, 1]] = NO


@compiled(
    "(f4[:, :, ::1], f4[:, ::1], f4[:, ::1], f4[:, ::1], UniTuple(f4, 5), i8, u1[:, ::1])",
    writes=("cells",),
)
def free_cells(
    odds: Floats, shown: Floats, mean_floor: Floats, level: Floats, limits: Limits, speck: int, cells: Bytes
) -> None:
    """Write the cells (H, W): 0 unknown, 1 free, 2 taken.

    odds (5, H, W): of all layers; shown (H, W): mean surface of single pairs; mean_floor (H, W): mean of the floor
    around a cell; level (H, W): log-odds against steps. limits: log-odds above which a cell is floor, visible, taken,
    those of a surface above which it is suspect, and `shown` above which it is. speck: most cells of a patch of noise.
    """
    height, width = cells.shape
    unknown, steps = np.zeros((height + 2, width + 2), np.uint8), np.zeros((height + 2, width + 2), np.uint8)
    inside, count = slice(1, width + 1), np.empty(width, np.uint8)
    for i in range(height):
        row = unknown[i + 1, inside]
        judge(odds[FLOOR, i], odds[SURFACE, i], odds[VISIBLE, i], shown[i], mean_floor[i], level[i], limits, row)
    # Specks are noise unless something may stand there.
    remove_specks(odds, shown, limits, speck, unknown)
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
            into[j] = TAKEN if surface[j] > limits[2] else (YES if is_free else NO)
