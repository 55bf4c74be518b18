"""Compiled loops over the cells of the obstacle grid: the evidence of a pair is added to log-odds.

All loops along rows are innermost and without branches: the compiler turns them into vector instructions. Windows
(N, N) are parts of squares (H, W); corner (2,): row and column of their first cell.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from omnid.core.compiled import compiled, inner

Floats = NDArray[np.float32]
Bytes = NDArray[np.uint8]
Corner = tuple[int, int]
Number = Any  # np.float32, or a float that becomes one
Three = tuple[Number, Number, Number]
Limits = tuple[Number, Number, Number, Number]

FLOOR, ABOVE, BELOW, SURFACE, VISIBLE = 0, 1, 2, 3, 4  # layers of log-odds, as in grid_layers.py
# Exact; numbers of other types would make sums of 64 bits.
NOTHING, ONE, TWO, INFINITE = np.float32(0.0), np.float32(1.0), np.float32(2.0), np.float32(np.inf)


@inner
def bounded(value: Number, low: Number, high: Number) -> Number:
    """Return a value, or the limit that it is beyond."""
    value = value if value > low else low
    return value if value < high else high


@inner
def seen(floor: Number, most: Number) -> Number:
    """Return the evidence of the floor of a cell within +-most, 0 where nothing can be seen (NaN)."""
    return bounded(floor if abs(floor) < INFINITE else NOTHING, -most, most)


@compiled("(f4[:, ::1], f4[:, ::1], UniTuple(i8, 2), f4, f4[:, ::1])", writes=("hidden",))
def hidden_odds(floor: Floats, mean: Floats, corner: Corner, most: np.float32, hidden: Floats) -> None:
    """Write the log-odds (N, N) that the floor is hidden, which are at most +-most, 0 where nothing can be seen.

    The evidence (N, N) has the variance 2 about the usual m of the mean (H, W), or about 0: m/2 (m/2 - floor).
    """
    for i in range(hidden.shape[0]):
        usual = mean[corner[0] + i, corner[1] : corner[1] + hidden.shape[1]]
        for j in range(hidden.shape[1]):
            half = usual[j] / TWO
            odds = bounded(half * (half - seen(floor[i, j], most)), -most, most)
            hidden[i, j] = odds if abs(floor[i, j]) < INFINITE else NOTHING


@compiled("(f4[:, ::1], f4[:, ::1], UniTuple(i8, 2), f4, f4, f4[:, ::1])", writes=("mean",))
def learn(floor: Floats, by_odds: Floats, corner: Corner, most: np.float32, share: np.float32, mean: Floats) -> None:
    """Take evidence (N, N) into the mean (H, W), where it is not hidden; by_odds (N, N): exp of the odds that it is."""
    for i in range(floor.shape[0]):
        usual = mean[corner[0] + i, corner[1] : corner[1] + floor.shape[1]]
        for j in range(floor.shape[1]):
            changed = usual[j] + share / (ONE + by_odds[i, j]) * (seen(floor[i, j], most) - usual[j])
            changed = changed if changed > NOTHING else NOTHING
            usual[j] = changed if abs(floor[i, j]) < INFINITE else usual[j]


@inner
def surfaces(floor: Floats, surface: Floats, gone: Bytes, odds: Floats, limits: Limits, into: Floats) -> None:
    """Write the evidence of surfaces (N,) less that of noise; gone: 1 where a surface would be seen."""
    noise_seen, noise_unseen, most, taken = limits
    for j in range(len(into)):
        noise = noise_seen if abs(floor[j]) < INFINITE else noise_unseen
        # An obstacle that is hidden or too near to be seen remains one.
        stays = (surface[j] <= NOTHING) & (not abs(floor[j]) < INFINITE) & (gone[j] == np.uint8(0)) & (odds[j] > taken)
        value = surface[j] - (NOTHING if stays else noise)
        into[j] = value if value < most else most


@inner
def add_bounded(values: Floats, weight: Number, most: Number, low: Number, high: Number, odds: Floats) -> None:
    """Add weight * values (N,), which are at most +-most, to log-odds (N,) from low to high."""
    for j in range(len(odds)):
        odds[j] = bounded(odds[j] + weight * bounded(values[j], -most, most), low, high)


@inner
def add_floor(
    floor: Floats, surface: Floats, lost: Floats, usual: Floats, limits: Limits, weight: Number, odds: Floats
) -> None:
    """Add the evidence of the floor (N,) to its log-odds."""
    most, least_usual, low, high = limits
    for j in range(len(odds)):
        value = seen(floor[j], most)
        below = value if value < NOTHING else NOTHING
        is_surface = surface[j] > NOTHING
        # Where floor is usual, a single cell that shows none is noise unless all floor behind it is hidden, too.
        least = NOTHING if (not is_surface) & (lost[j] <= NOTHING) & (usual[j] > least_usual) else -most
        value = below if is_surface else value
        odds[j] = bounded(odds[j] + weight * (value if value > least else least), low, high)


@inner
def add_surface(floor: Floats, surface: Floats, limits: Limits, weights: Three, odds: Floats) -> None:
    """Add the evidence of surfaces (N,) to their log-odds."""
    pairs, low, high, contradiction = limits
    weight, at_rest, _ = weights
    for j in range(len(odds)):
        is_surface = surface[j] > NOTHING
        # The sum over pairs from one place tends to their mean, so many times: what is no surface stays none.
        surplus = (odds[j] - low) / pairs if is_surface else NOTHING
        value = contradiction if (floor[j] > NOTHING) & (not is_surface) else surface[j]
        odds[j] = bounded(odds[j] + (weight * value - at_rest * surplus), low, high)


@inner
def add_shown(floor: Floats, beside: Bytes, amount: Floats, share: Number, shown: Floats) -> None:
    """Take the amount of a surface (N,) that a pair shows into the mean of single pairs, of cells that it shows."""
    for j in range(len(shown)):
        changed = shown[j] + share * (amount[j] - shown[j])
        is_shown = (abs(floor[j]) < INFINITE) | (beside[j] > np.uint8(0)) | (amount[j] > NOTHING)
        shown[j] = changed if is_shown else shown[j]


@compiled(
    "(f4[:, :, ::1], u1[:, ::1], u1[:, ::1], f4[:, ::1], f4[:, ::1], f4[:, ::1], UniTuple(i8, 2), UniTuple(f4, 3), "
    "UniTuple(f4, 4), UniTuple(f4, 4), UniTuple(f4, 4), UniTuple(f4, 3), f4[:, :, ::1], f4[:, ::1], f4[:, ::1])",
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
    of_surfaces: Limits,
    of_floors: Limits,
    of_surface_odds: Limits,
    of_visible: Three,
    odds: Floats,
    shown: Floats,
    amount: Floats,
) -> None:
    """Add the evidence of a pair to the log-odds (5, H, W) of a window; write the most of floor and surface (N, N).

    cells (5, N, N): evidence of `gather`; gone (N, N): 1 where a surface would be seen, beside (N, N): around it;
    surface_shown (N, N): surface for the mean of single pairs, shown (H, W); lost (H, W): log-odds that visible floor
    loses; usual (H, W): mean evidence of the floor.
    weights: of the pair, the part of it by time alone, of the pair in the mean of single pairs. of_surfaces: noise
    where floor is in view and where not, most surface of a pair, log-odds from which a cell is taken. of_floors: most
    floor of a pair, mean from which floor is usual, limits of log-odds. of_surface_odds: pairs from one place, limits
    of log-odds, evidence where floor is seen. of_visible: most of a pair, and limits of log-odds.
    """
    size = amount.shape[0]
    surface, row = np.empty(size, np.float32), slice(corner[1], corner[1] + size)
    weight, most, low, high = weights[0], of_floors[0], of_floors[2], of_floors[3]
    for i in range(size):
        at, floor = corner[0] + i, cells[FLOOR, i]
        surfaces(floor, cells[SURFACE, i], gone[i], odds[SURFACE, at, row], of_surfaces, surface)
        add_shown(floor, beside[i], surface_shown[i], weights[2], shown[at, row])
        add_floor(floor, surface, lost[at, row], usual[at, row], of_floors, weight, odds[FLOOR, at, row])
        add_bounded(cells[ABOVE, i], weight, most, low, high, odds[ABOVE, at, row])
        add_bounded(cells[BELOW, i], weight, most, low, high, odds[BELOW, at, row])
        add_surface(floor, surface, of_surface_odds, weights, odds[SURFACE, at, row])
        add_bounded(lost[at, row], -weight, of_visible[0], of_visible[1], of_visible[2], odds[VISIBLE, at, row])
        for j in range(size):
            value = seen(floor[j], most)
            amount[i, j] = value if value > surface[j] else surface[j]
