"""Compiled loops over the cells of the obstacle grid: the evidence of a pair is added to log-odds.

All loops along rows are innermost and without branches: the compiler turns them into vector instructions. Windows
(N, N) are parts of squares (H, W); corner (2,): row and column of their first cell.
"""

from __future__ import annotations

from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from omnid.core.compiled import compiled, inner

Floats = NDArray[np.float32]
Bytes = NDArray[np.uint8]
Corner = tuple[int, int]
Number = Any  # np.float32, or a float that becomes one
Three = tuple[Number, Number, Number]

# Layers: floor against upright surfaces, against planes just above and below it; surface; visible floor against floor
# that something plain hides.
FLOOR, ABOVE, BELOW, SURFACE, VISIBLE = 0, 1, 2, 3, 4
# Numbers have 32 bits, as sums with others would have 64.
NOTHING, ONE, TWO, INFINITE = np.float32(0.0), np.float32(1.0), np.float32(2.0), np.float32(np.inf)

# Log-odds where nothing was seen: floor that was not seen is not free, so that pairs must show it.
FLOOR_PRIOR, SURFACE_PRIOR, VISIBLE_PRIOR = np.float32(-1.0), np.float32(-6.0), np.float32(3.0)
LIMIT: Final = np.float32(6.0)  # Limit of all log-odds, so that a change is believed after a few pairs.
# Least log-odds of the floor, so that what was hidden for long is free again after few pairs.
FLOOR_LOW: Final = np.float32(-3.0)
# Least log-odds against an edge, so that it stays where it is. With -3, by trial, three pairs in which ribs beyond it
# fit as floor by another period outweighed all those before.
EDGE_LOW: Final = np.float32(-12.0)
TAKEN_ODDS: Final = np.float32(0.0)  # Log-odds of a surface from which a cell is occupied.
# Of the floor, of a cell and a pair: the errors of pairs that follow each other are alike, so that a few count.
MOST_RATIO: Final = np.float32(3.0)
# Mean evidence of a cell's floor from which it is usual. With 1.5 and 2, by trial, more bases stood on polished floors;
# of the directions of white poles as many were free with all three.
USUAL: Final = np.float32(1.0)
# Of a surface: six pairs are needed. With 1.5 and 3.0, by trial, one that was none stopped a base in a corridor.
MOST_SURFACE: Final = np.float32(1.0)
# Mean evidence of a surface where there is none, as the best of many runs is never negative: below 0.13 in 95 % of the
# cells of bare floor. It would add up as the robot moves: two of three false surfaces before plain walls came of it.
NOISE_SURFACE: Final = np.float32(0.15)
# The same where no floor is in view, because nothing contradicts a surface there; and in the mean of single pairs: that
# before a shelf fell from 0.15 to 0.055 by it, and that at tables from 0.17 to 0.12 (development seeds).
UNSEEN_SURFACE: Final = np.float32(0.4)
# Log-odds of a surface where floor is seen and no surface; by trial on development seeds.
CONTRADICTION: Final = np.float32(-1.5)
# Pairs from one place are no more than so many, as to a surface: 6 / 18 parts the evidence of bare floor (0.13 a pair
# below 95 % of its cells) from that of walls and boxes (0.8, median), in the world `room` at rest, development seed 1.
PLACE_PAIRS: Final = np.float32(18.0)
MOST_VISIBLE: Final = np.float32(1.0)  # Limit of one pair: three that show no floor where it was end a free cell.
LEAST_VISIBLE: Final = np.float32(-1.0)  # One or two pairs with the usual evidence make it free again.


@inner
def bounded(value: Number, low: Number, high: Number) -> Number:
    """Return a value, or the limit that it is beyond."""
    value = value if value > low else low
    return value if value < high else high


@inner
def seen(floor: Number) -> Number:
    """Return the evidence of the floor of a cell within its limits, 0 where nothing can be seen (NaN)."""
    return bounded(floor if abs(floor) < INFINITE else NOTHING, -MOST_RATIO, MOST_RATIO)


@compiled("(f4[:, ::1], f4[:, ::1], UniTuple(i8, 2), f4[:, ::1])", writes=("hidden",))
def hidden_odds(floor: Floats, mean: Floats, corner: Corner, hidden: Floats) -> None:
    """Write the log-odds (N, N) that the floor is hidden, at most +-MOST_RATIO, 0 where nothing can be seen.

    The evidence (N, N) has the variance 2 about the usual m of the mean (H, W), or about 0: m/2 (m/2 - floor).
    """
    for i in range(hidden.shape[0]):
        usual = mean[corner[0] + i, corner[1] : corner[1] + hidden.shape[1]]
        for j in range(hidden.shape[1]):
            half = usual[j] / TWO
            odds = bounded(half * (half - seen(floor[i, j])), -MOST_RATIO, MOST_RATIO)
            hidden[i, j] = odds if abs(floor[i, j]) < INFINITE else NOTHING


@compiled("(f4[:, ::1], f4[:, ::1], UniTuple(i8, 2), f4, f4[:, ::1])", writes=("mean",))
def learn(floor: Floats, by_odds: Floats, corner: Corner, share: np.float32, mean: Floats) -> None:
    """Take evidence (N, N) into the mean (H, W), where it is not hidden; by_odds (N, N): exp of the odds that it is."""
    for i in range(floor.shape[0]):
        usual = mean[corner[0] + i, corner[1] : corner[1] + floor.shape[1]]
        for j in range(floor.shape[1]):
            changed = usual[j] + share / (ONE + by_odds[i, j]) * (seen(floor[i, j]) - usual[j])
            changed = changed if changed > NOTHING else NOTHING
            usual[j] = changed if abs(floor[i, j]) < INFINITE else usual[j]


@inner
def surfaces(floor: Floats, surface: Floats, gone: Bytes, odds: Floats, into: Floats) -> None:
    """Write the evidence of surfaces (N,) less that of noise; gone: 1 where a surface would be seen."""
    for j in range(len(into)):
        noise = NOISE_SURFACE if abs(floor[j]) < INFINITE else UNSEEN_SURFACE
        # An obstacle that is hidden or too near to be seen remains one.
        is_hidden = (surface[j] <= NOTHING) & (not abs(floor[j]) < INFINITE) & (gone[j] == np.uint8(0))
        stays = is_hidden & (odds[j] > TAKEN_ODDS)
        value = surface[j] - (NOTHING if stays else noise)
        into[j] = value if value < MOST_SURFACE else MOST_SURFACE


@inner
def add_bounded(values: Floats, weight: Number, most: Number, low: Number, high: Number, odds: Floats) -> None:
    """Add weight * values (N,), which are at most +-most, to log-odds (N,) from low to high."""
    for j in range(len(odds)):
        odds[j] = bounded(odds[j] + weight * bounded(values[j], -most, most), low, high)


@inner
def add_floor(floor: Floats, surface: Floats, lost: Floats, usual: Floats, weight: Number, odds: Floats) -> None:
    """Add the evidence of the floor (N,) to its log-odds."""
    for j in range(len(odds)):
        value = seen(floor[j])
        below = value if value < NOTHING else NOTHING
        is_surface = surface[j] > NOTHING
        # Where floor is usual, a single cell that shows none is noise unless all floor behind it is hidden, too.
        least = NOTHING if (not is_surface) & (lost[j] <= NOTHING) & (usual[j] > USUAL) else -MOST_RATIO
        value = below if is_surface else value
        odds[j] = bounded(odds[j] + weight * (value if value > least else least), FLOOR_LOW, LIMIT)


@inner
def add_surface(floor: Floats, surface: Floats, weights: Three, odds: Floats) -> None:
    """Add the evidence of surfaces (N,) to their log-odds."""
    weight, at_rest, _ = weights
    for j in range(len(odds)):
        is_surface = surface[j] > NOTHING
        # The sum over pairs from one place tends to their mean, so many times: what is no surface stays none.
        surplus = (odds[j] - SURFACE_PRIOR) / PLACE_PAIRS if is_surface else NOTHING
        value = CONTRADICTION if (floor[j] > NOTHING) & (not is_surface) else surface[j]
        odds[j] = bounded(odds[j] + (weight * value - at_rest * surplus), SURFACE_PRIOR, LIMIT)


@inner
def add_shown(floor: Floats, beside: Bytes, amount: Floats, share: Number, shown: Floats) -> None:
    """Take the amount of a surface (N,) that a pair shows into the mean of single pairs, of cells that it shows."""
    for j in range(len(shown)):
        changed = shown[j] + share * (amount[j] - shown[j])
        is_shown = (abs(floor[j]) < INFINITE) | (beside[j] > np.uint8(0)) | (amount[j] > NOTHING)
        shown[j] = changed if is_shown else shown[j]


@compiled(
    "(f4[:, :, ::1], u1[:, ::1], u1[:, ::1], f4[:, ::1], f4[:, ::1], f4[:, ::1], UniTuple(i8, 2), UniTuple(f4, 3), "
    "f4[:, :, ::1], f4[:, ::1], f4[:, ::1])",
    writes=("odds", "shown", "amount"),
)
def add_pair(
    cells: Floats,
    gone: Bytes,
    beside: Bytes,
    surface_shown: Floats,
    lost: Floats,
    usual: Floats,
    corner: Corner,
    weights: Three,
    odds: Floats,
    shown: Floats,
    amount: Floats,
) -> None:
    """Add the evidence of a pair to the log-odds (5, H, W) of a window; write the most of floor and surface (N, N).

    cells (5, N, N): evidence of `gather`; gone (N, N): 1 where a surface would be seen, beside (N, N): around it;
    surface_shown (N, N): surface for the mean of single pairs, shown (H, W); lost (H, W): log-odds that visible floor
    loses; usual (H, W): mean evidence of the floor.
    weights: of the pair, the part of it by time alone, of the pair in the mean of single pairs.
    """
    size, weight = amount.shape[0], weights[0]
    surface, row = np.empty(size, np.float32), slice(corner[1], corner[1] + size)
    for i in range(size):
        at, floor = corner[0] + i, cells[FLOOR, i]
        surfaces(floor, cells[SURFACE, i], gone[i], odds[SURFACE, at, row], surface)
        add_shown(floor, beside[i], surface_shown[i], weights[2], shown[at, row])
        add_floor(floor, surface, lost[at, row], usual[at, row], weight, odds[FLOOR, at, row])
        add_bounded(cells[ABOVE, i], weight, MOST_RATIO, FLOOR_LOW, LIMIT, odds[ABOVE, at, row])
        add_bounded(cells[BELOW, i], weight, MOST_RATIO, EDGE_LOW, LIMIT, odds[BELOW, at, row])
        add_surface(floor, surface, weights, odds[SURFACE, at, row])
        add_bounded(lost[at, row], -weight, MOST_VISIBLE, LEAST_VISIBLE, VISIBLE_PRIOR, odds[VISIBLE, at, row])
        for j in range(size):
            value = seen(floor[j])
            amount[i, j] = value if value > surface[j] else surface[j]


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
