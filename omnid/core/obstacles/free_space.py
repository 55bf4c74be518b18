"""Memory of the floor that was seen to be free, in odom, for what is too near to be seen or shows nothing now.

Near the robot the cameras see no floor, and a plain wall shows nothing at all: what is known there is where the free
floor ended when it was seen from farther away. Where a wide piece of floor is missing that was seen before, something
has come that hides it, though stereo sees nothing on it.

Where the base stands, nothing was seen from farther away. There the floor around it counts as free, as far as the
cameras cannot see it, except towards what hides it in a wide angle.

What this cannot know: something that stereo does not see and that is narrower than HIDDEN_SECTORS, or nearer than the
floor in view where the base starts. Wider patches of floor without edges count as unknown.
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
ASSUMED_SECTORS: Final = 60  # side by side without floor; from here on, something near hides it also where none is seen
RESTING_M: Final = 0.05  # within which a base stands
END_M: Final = 0.15  # before the end of the floor that was seen: steps of 0.1 m and the noise of stereo
MISSED_NS: Final = 1_500_000_000  # after which floor that is in view and not seen any more is not free
IN_VIEW_M: Final = 2.5  # up to here floor is seen now and then, also where it has few edges
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
        self._rest: tuple[Array, int] | None = None  # place [m] where the base stands, and since when

    def clear(self) -> None:
        """Forget everything."""
        self._hidden_before[:] = False
        self._rest = None
        self._seen_ns[:] = np.iinfo(np.int64).min

    def update(self, stamp_ns: int, T_odom_base: Array, free_m: Array, floor_from_m: float = math.inf
               ) -> tuple[Array, NDArray[np.bool_]]:
        """Add the free ranges (SECTORS,) of a pair, 0 where nothing was seen; return those that are known now.

        A direction in which some floor is seen now says all there is. Where none is seen, memory counts, and in fewer
        directions than HIDDEN_SECTORS those beside them; memory loses what is in view and is not seen any more.
        Returned beside it is where something new hides the floor: two pairs saw nothing in HIDDEN_SECTORS, and memory
        knows floor at least HIDDEN_M beyond floor_from_m, from which on the cameras see floor elsewhere.
        """
        centre = T_odom_base[:2, 3] / CELL_M
        self._follow(centre)
        angle = self._directions + math.atan2(T_odom_base[1, 0], T_odom_base[0, 0])
        direction = np.column_stack([np.cos(angle), np.sin(angle)])
        # 1. Floor that counts as free: seen in this pair, or too near to be seen where the base stands.
        unseen = free_m <= 0
        assumed = np.zeros_like(unseen)
        if self._stands(stamp_ns, T_odom_base[:2, 3]) and math.isfinite(floor_from_m):
            assumed = unseen & ~_wide(unseen, ASSUMED_SECTORS)
        reach_m = np.where(assumed, floor_from_m, np.maximum(free_m - END_M, 0.0))
        drawn = self._drawn(centre, reach_m, direction, unseen & ~assumed)
        x, y = np.floor(centre).astype(np.int64) - self._corner
        drawn[y, x] = True  # the robot stands there
        self._seen_ns[drawn] = stamp_ns
        # 2. Memory: without what is in view and is missed, so that it does not reach through what has come.
        if math.isfinite(floor_from_m):
            self._forget_missed(stamp_ns, centre, floor_from_m + 2 * CELL_M)
        remembered = self._remembered(stamp_ns, centre, direction)
        # 3. Floor that is remembered and missed in a wide angle, in two pairs: something hides it.
        wide = _wide(unseen & (remembered > floor_from_m + HIDDEN_M), HIDDEN_SECTORS)
        shifts = range(-SAME_SECTORS, SAME_SECTORS + 1)
        is_hidden = wide & np.logical_or.reduce([np.roll(self._hidden_before, shift) for shift in shifts])
        self._hidden_before = wide
        known = np.where(unseen, remembered, free_m)
        return np.where(is_hidden, 0.0, np.where(unseen, _without_dips(known, HIDDEN_SECTORS), known)), is_hidden

    def _stands(self, stamp_ns: int, position: Array) -> bool:
        """True at the start, and where the base has stood for so long that memory has ended."""
        if self._rest is None:
            self._rest = (position.copy(), stamp_ns - self._memory_ns)
        elif math.dist(position, self._rest[0]) > RESTING_M:
            self._rest = (position.copy(), stamp_ns)
        return stamp_ns - self._rest[1] >= self._memory_ns

    def _drawn(self, centre: Array, free_m: Array, direction: Array, blind: NDArray[np.bool_]) -> NDArray[np.bool_]:
        """Return the cells within ranges (SECTORS,) along directions (SECTORS, 2), without those of blind sectors."""
        longest = self._distances[-1]
        drawn = np.zeros((CELLS, CELLS), np.uint8)
        # Near the robot, cells are wider than directions: those that a blind direction touches are left out.
        for reach_m, value in ((np.minimum(free_m, longest), 1), (np.where(blind, longest, 0.0), 0)):
            corners = centre - self._corner - 0.5 + reach_m[:, None] / CELL_M * direction
            cv2.fillPoly(drawn, [np.rint(corners * 2**SHIFT).astype(np.int32)], value, shift=SHIFT)
        return drawn > 0

    def _forget_missed(self, stamp_ns: int, centre: Array, from_m: float) -> None:
        """Forget cells from a distance on that are in view and were not seen for MISSED_NS: something hides them."""
        x, y = (CELL_M * (np.arange(CELLS) + 0.5 + first - at) for first, at in zip(self._corner, centre, strict=True))
        distance2 = y[:, None] ** 2 + x[None, :] ** 2
        in_view = (distance2 > from_m**2) & (distance2 < IN_VIEW_M**2)
        self._seen_ns[in_view & (self._seen_ns < stamp_ns - MISSED_NS)] = np.iinfo(np.int64).min

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


def _without_dips(values: Array, least: int) -> Array:
    """Return values (SECTORS,) with dips narrower than so many sectors filled up to the lower of their sides."""
    highest = np.maximum.reduce([np.roll(values, shift) for shift in range(least)])
    return np.asarray(np.minimum.reduce([np.roll(highest, -shift) for shift in range(least)]))
