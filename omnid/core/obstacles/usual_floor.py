"""Usual evidence of each cell of the floor, and where floor that was free is suddenly hidden: something has come.

A person hides all floor behind the feet from one image to the next, while the grid's log-odds, which are sums of many
pairs, follow later. So each cell keeps the mean of its evidence, and a pair is judged against it. README.md has the
equations.
"""

from __future__ import annotations

from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from omnid.core.obstacles import grid_kernels as kernels
from omnid.core.obstacles.cell_kernels import hidden_odds, learn

Floats = NDArray[np.float32]
Flags = NDArray[np.bool_]
Array = NDArray[np.float64]

# Share of a pair that counts in full in the mean. With 0.5, by trial, the mean behind a plain pole was forgotten before
# the base came to it, as F is about 0 there; it need not follow faster than F falls from 3.3 at 4 m to 1.5 at 1 m.
LEARNED: Final = np.float32(0.2)
HIDDEN_SUM: Final = 6.0  # log-odds of a direction, by which floor is hidden, because two disparities in full have them
# Part of the log-odds without any evidence from which floor is hidden, because F is then below a quarter of the usual
# in the mean.
HIDDEN_SHARE: Final = 0.5
# Sigma of the range at which hidden floor begins, in disparities, because it is anywhere in one: 1 / sqrt(12).
BIN_SIGMA: Final = 0.3
# The same where nearer floor is not in view, as a share of the range, because it is anywhere before it: 1 / sqrt(12).
NEAR_SIGMA: Final = 0.3
# Length of floor that was not free lately and ends a free way, because it may be the base of an object.
GAP_M: Final = 0.1


class Arrivals(NamedTuple):
    """Ranges from the viewpoint of what has come onto floor that was free, by one pair."""

    ranges_m: Floats  # (SECTORS,) from which on that floor is hidden, NaN where it is not
    sigma_m: Floats  # (SECTORS,)
    is_nearer: Flags  # (SECTORS,) the nearest floor in view is hidden: the range is the most that it may be


class Hidden(NamedTuple):
    """Floor that was seen lately and is hidden, by one pair."""

    ranges_m: Array  # (N,) along directions, from which on it is, NaN where it is not
    near: Floats  # (N,) log-odds that what hides it stands nearer than the nearest floor in view; 0: not known
    behind: Flags  # (H, W) hidden cells


class UsualFloor:
    """Mean evidence of the floor of cells (N, N), 0 where it has not been seen."""

    def __init__(self, cells: int) -> None:
        self.mean = np.zeros((cells, cells), np.float32)

    def compare(self, window: tuple[slice, slice], floor: Floats, weight: np.float32) -> Floats:
        """Return the log-odds (N, N) that the floor is hidden, 0 out of a window, and learn where it is not.

        floor: of the window, evidence of a pair, NaN where nothing can be seen.
        """
        corner, hidden = (window[0].start, window[1].start), np.empty_like(floor)
        hidden_odds(floor, self.mean, corner, hidden)
        # Hidden cells are no evidence of the floor.
        learn(floor, np.exp(hidden), corner, LEARNED * weight, self.mean)
        found = np.zeros_like(self.mean)
        found[window] = hidden
        return found

    def hidden(
        self, odds: Floats, was_floor: Flags, taken: Flags, origin: Array, azimuths: Array, nearest_m: float
    ) -> Hidden:
        """Return where floor is hidden.

        odds (H, W): log-odds of `compare`; was_floor: lately; taken: occupied by an object. origin (5,): viewpoint
        [cells], size of a cell [m], longest range [m], disparity at 1 m; azimuths (N,) of the directions in odom;
        nearest_m: up to where floor is the nearest in view.
        """
        ranges_m, near, behind = np.empty(len(azimuths)), np.empty(len(azimuths), np.float32), np.zeros_like(was_floor)
        flags = was_floor.view(np.uint8), taken.view(np.uint8)
        bounds = np.array([HIDDEN_SUM, GAP_M, nearest_m, HIDDEN_SHARE])
        kernels.hidden_from(odds, self.mean, *flags, origin, azimuths, bounds, ranges_m, near, behind.view(np.uint8))
        return Hidden(ranges_m, near, behind)


def arrivals_at(ranges_m: Array, nearest_m: float, at_1m: float) -> Arrivals:
    """Return what hides floor from ranges (N,) on; nearest_m: of the floor in view, at_1m: disparity at 1 m."""
    # An object that hides the nearest floor in view may be anywhere before it.
    is_nearer = ranges_m < nearest_m
    sigma_m = np.where(is_nearer, NEAR_SIGMA * ranges_m, ranges_m**2 * (BIN_SIGMA / at_1m))
    return Arrivals(ranges_m.astype(np.float32), sigma_m.astype(np.float32), is_nearer)
