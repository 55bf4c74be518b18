"""Usual evidence of each cell of the floor, and where floor that was free is suddenly hidden: something has come.

A person hides all floor behind the feet from one image to the next, while the grid's log-odds, which are sums of many
pairs, follow later. So each cell keeps the mean of its evidence, and a pair is judged against it. How fresh the
evidence of a cell is (`Watch`) says where something may have come unseen. The equations are in docs/obstacles.md.
"""

from __future__ import annotations

import math
from typing import Any, Final, NamedTuple

import cv2
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


NEVER: Final = np.iinfo(np.int64).min
# Time constant of the mean by which a cell is watched, because older evidence shows no motion.
FRESH_NS: Final = 500_000_000
# Most evidence of a pair in the mean, because an object that leaves is noticed in half a second.
MOST_FRESH: Final = 1.2
LEAST_FRESH: Final = 0.4  # Mean evidence from which a cell is watched, because that of noise is 0.2.
FLOOD_MPS: Final = 1.6  # Speed at which an object may enter hidden cells, because a person who walks fast has it.
NARROW_CELLS: Final = 5  # Width from which an object may enter, because that of a person is 25 cm and more.
CROSS: Final = np.array(
    [[0, 1, 0], [1, 1, 1], [0, 1, 0]], np.uint8
)  # By turns with a square, a step of the flood is nearly a circle.
GAP: Final = np.ones((3, 3), np.uint8)  # Nothing comes through narrower gaps, because noise opens such in walls.
# An object may have come for so long through a hidden cell that was free, because a door may have been opened.
ONCE_FREE_NS: Final = 30_000_000_000


class Watch:
    """Mean evidence of each cell of a square, when it was free last, and whether something may be there unseen."""

    def __init__(self, cells: int, cell_m: float) -> None:
        """cells: side of the square; cell_m: side of a cell."""
        self._steps_per_s = FLOOD_MPS / cell_m
        self._carry = 0.0  # part of a step that is left from the pair before
        self.evidence = np.zeros((cells, cells), np.float32)  # mean of the last FRESH_NS
        self.floor_ns = np.full((cells, cells), NEVER, np.int64)  # stamp of the last pair at which a cell was floor
        self.free_ns = self.floor_ns.copy()  # the same of cells that were free by all layers
        self.flooded = np.zeros((cells, cells), np.uint8)  # 1 where something may have come unseen

    @property
    def layers(self) -> tuple[tuple[NDArray[Any], float], ...]:
        """The layers (cells, cells), and what each holds where nothing is known."""
        return (self.evidence, 0), (self.floor_ns, NEVER), (self.free_ns, NEVER), (self.flooded, 0)

    @property
    def watched(self) -> Flags:
        """Cells of which there is enough evidence lately."""
        return np.asarray(self.evidence > LEAST_FRESH)

    def was_floor(self, stamp_ns: int) -> Flags:
        """Return the cells that were floor lately, at a stamp."""
        return np.asarray(self.floor_ns > stamp_ns - ONCE_FREE_NS)

    def take(self, passed_ns: int, window: tuple[slice, slice], amount: Floats) -> None:
        """Take the amount of evidence of a pair in a window into the mean, passed_ns after the pair before."""
        kept = math.exp(-passed_ns / FRESH_NS)
        self.evidence *= np.float32(kept)
        self.evidence[window] += np.float32(1 - kept) * np.clip(amount, 0, MOST_FRESH)

    def spread(self, stamp_ns: int, passed_ns: int, floor: Flags, visible: Flags) -> Flags:
        """Return the cells of floor to which something may have come that was not seen.

        floor: cells of seen floor; visible: those that a pair can show.
        """
        self._carry += min(passed_ns * 1e-9, 1.0) * self._steps_per_s
        steps, self._carry = int(self._carry), self._carry % 1.0
        unwatched = ~self.watched
        self.floor_ns[floor] = stamp_ns
        # 1. Where it may come from: what was free by all layers, wider than an object, and is hidden or lost. Noise
        # shows floor beyond walls, too, through which nothing comes.
        was_free = self.free_ns > stamp_ns - ONCE_FREE_NS
        lost = (unwatched & (visible | ~floor) & was_free).view(np.uint8)
        box = np.ones((NARROW_CELLS, NARROW_CELLS), np.uint8)
        reached = np.asarray(cv2.morphologyEx(lost, cv2.MORPH_OPEN, box), np.uint8) | (self.flooded & lost)
        # 2. How far it may have come since the pair before, through what is not watched.
        ways = (floor & unwatched).view(np.uint8) | lost
        passable = np.asarray(cv2.morphologyEx(ways, cv2.MORPH_OPEN, GAP), np.uint8)
        for step in range(steps):
            kernel = np.ones((3, 3), np.uint8) if step % 2 else CROSS
            reached = np.asarray(cv2.dilate(reached, kernel), np.uint8) & passable
        self.flooded[:] = reached
        return np.asarray((reached > 0) & floor)
