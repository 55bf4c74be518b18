"""Memory of the floor that was seen to be free, in odom, for what is too near to be seen or shows nothing now.

Near the robot the cameras see no floor, and a plain wall shows nothing at all: what is known there is where the free
floor ended when it was seen from farther away. Where a wide piece of floor is missing that was seen before, something
has come that hides it, though stereo sees nothing on it.
"""

from __future__ import annotations

import math
from typing import Final

import cv2
import numpy as np
from numpy.typing import NDArray

from omnid.core.mapping.range_scan import azimuths

Array = NDArray[np.float64]

CELL_M: Final = 0.05
CELLS: Final = 256  # on each side of the square; it follows the robot
MARGIN_CELLS: Final = 90  # nearer to the border than this, the square is moved; no direction is looked up farther
STEP_M: Final = 0.05  # along a direction that is looked up
HIDDEN_M: Final = 0.3  # of floor that is missing, beyond the nearest that the cameras see
HIDDEN_SECTORS: Final = 12  # side by side, in two pairs: floor of few edges is missed in fewer, or once
SAME_SECTORS: Final = 5  # by which what hides it has moved from pair to pair
SHIFT: Final = 4  # fractional bits of the corners that are drawn


class FreeSpace:
    """Stamps of the cells that were seen to be free, in a square around the robot of bounded size."""

    def __init__(self, reach_m: float, memory_s: float) -> None:
        """reach_m: farthest distance that is looked up; memory_s: for which a cell stays free."""
        self._memory_ns = round(memory_s * 1e9)
        steps = int(min(reach_m, (MARGIN_CELLS - 2) * CELL_M) / STEP_M)
        self._distances = STEP_M * np.arange(1, steps + 1)
        self._seen_ns = np.full((CELLS, CELLS), np.iinfo(np.int64).min, np.int64)
        self._corner = np.zeros(2, np.int64)  # cell (0, 0) in odom
        self._directions = azimuths()
        self._hidden_before = np.zeros(len(self._directions), bool)

    def clear(self) -> None:
        """Forget everything."""
        self._hidden_before[:] = False
        self._seen_ns[:] = np.iinfo(np.int64).min

    def update(self, stamp_ns: int, T_odom_base: Array, free_m: Array, floor_from_m: float = math.inf
               ) -> tuple[Array, NDArray[np.bool_]]:
        """Add the free ranges (SECTORS,) of a pair, 0 where nothing was seen; return those that are known now.

        A direction in which some floor is seen now says all there is; only where none is seen, memory counts. Returned
        beside it is where something new hides the floor: two pairs saw nothing in HIDDEN_SECTORS, and memory knows
        floor at least HIDDEN_M beyond floor_from_m, from which on the cameras see floor elsewhere.
        """
        centre = T_odom_base[:2, 3] / CELL_M
        self._follow(centre)
        angle = self._directions + math.atan2(T_odom_base[1, 0], T_odom_base[0, 0])
        direction = np.column_stack([np.cos(angle), np.sin(angle)])
        remembered = self._remembered(stamp_ns, centre, direction)
        longest = self._distances[-1]
        corners = centre - self._corner - 0.5 + np.minimum(free_m, longest)[:, None] / CELL_M * direction
        drawn = np.zeros((CELLS, CELLS), np.uint8)
        cv2.fillPoly(drawn, [np.rint(corners * 2**SHIFT).astype(np.int32)], 1, shift=SHIFT)
        # Near the robot, cells are wider than directions: those that a direction without floor touches are not free.
        blind = centre - self._corner - 0.5 + np.where(free_m > 0, 0.0, longest)[:, None] / CELL_M * direction
        cv2.fillPoly(drawn, [np.rint(blind * 2**SHIFT).astype(np.int32)], 0, shift=SHIFT)
        x, y = np.floor(centre).astype(np.int64) - self._corner
        drawn[y, x] = 1  # the robot stands there
        self._seen_ns[drawn > 0] = stamp_ns
        wide = _wide((free_m <= 0) & (remembered > floor_from_m + HIDDEN_M), HIDDEN_SECTORS)
        shifts = range(-SAME_SECTORS, SAME_SECTORS + 1)
        is_hidden = wide & np.logical_or.reduce([np.roll(self._hidden_before, shift) for shift in shifts])
        self._hidden_before = wide
        return np.where(is_hidden, 0.0, np.where(free_m > 0, free_m, remembered)), is_hidden

    def _remembered(self, stamp_ns: int, centre: Array, direction: Array) -> Array:
        """Return how far (SECTORS,) all cells along the directions (SECTORS, 2) were free."""
        at = centre - self._corner + self._distances[None, :, None] / CELL_M * direction[:, None, :]
        cells = np.floor(at).astype(np.intp)
        seen_ns = self._seen_ns[cells[..., 1], cells[..., 0]]
        is_free = (seen_ns <= stamp_ns) & (seen_ns >= stamp_ns - self._memory_ns)
        ends = np.where(is_free.all(axis=1), len(self._distances), np.argmin(is_free, axis=1))
        return np.asarray(ends * STEP_M)

    def _follow(self, centre: Array) -> None:
        """Move the square where the robot comes near its border."""
        at = np.floor(centre).astype(np.int64) - self._corner
        if ((at >= MARGIN_CELLS) & (at < CELLS - MARGIN_CELLS)).all():
            return
        moved = np.full_like(self._seen_ns, np.iinfo(np.int64).min)
        shift = at - CELLS // 2
        if (np.abs(shift) < CELLS).all():
            x, y = shift.tolist()
            kept = self._seen_ns[max(y, 0) : CELLS + min(y, 0), max(x, 0) : CELLS + min(x, 0)]
            moved[max(-y, 0) : CELLS - max(y, 0), max(-x, 0) : CELLS - max(x, 0)] = kept
        self._seen_ns = moved
        self._corner += shift


def _wide(marked: NDArray[np.bool_], least: int) -> NDArray[np.bool_]:
    """Return the marked sectors that stand in a run of at least so many, around the full turn."""
    begins = marked.copy()
    for shift in range(1, least):
        begins &= np.roll(marked, -shift)
    return np.asarray(np.logical_or.reduce([np.roll(begins, shift) for shift in range(least)]))
