"""Memory of the floor that was seen to be free, in odom, for what is too near to be seen or shows nothing now.

Near the robot the cameras see no floor, and a plain wall shows nothing at all: what is known there is where the free
floor ended when it was seen from farther away. In view, memory counts as long as the floor looks as it did: what looks
otherwise is hidden by something that has come, though stereo may see nothing of it, and so is all behind, unless both
cameras see the plane of the floor there: a shadow. What covers the nearest floor in view may stand nearer still, unless
the ring has it.

Where the base stands, nothing was seen from farther away. There the floor around it counts as free, as far as the
cameras cannot see it, except towards what hides it in a wide angle.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Final, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import minimum_filter1d

from omnid.core.mapping.range_scan import SECTORS, RangeScan, azimuths
from omnid.core.obstacles.floor_memory import FloorMemory
from omnid.core.obstacles.floor_view import FloorView
from omnid.core.obstacles.observation import Observation

Array = NDArray[np.float64]
Counts = NDArray[np.intp]
Flags = NDArray[np.bool_]

CELL_M: Final = 0.05
CELLS: Final = 256  # on each side of the square; it follows the robot
MARGIN_CELLS: Final = 90  # nearer to the border than this, the square is moved; no direction is looked up farther
STEP_M: Final = 0.05  # along a direction that is looked up
ASSUMED_SECTORS: Final = 60  # side by side without floor; from here on, something near hides it also where none is seen
RESTING_M: Final = 0.05  # within which a base stands
END_M: Final = 0.15  # before the end of the floor that was seen: steps of 0.1 m and the noise of stereo
VIEW_CELLS: Final = 50  # up to here the floor is compared: farther away a pixel is longer than two cells
NEAREST_STEPS: Final = 3  # that are the nearest floor in view
SIDE_SECTORS: Final = 25  # to each side of a near obstacle, in which stereo may miss its sides
POSSIBLE_CELLS: Final = 5  # around a cell that was never free: the end of the floor is known to two cells
ROBOT_M: Final = 0.25  # nearer to the middle of the base nothing can come, and a cell belongs to many directions
MISSED_NS: Final = 1_500_000_000  # for which floor in view is free that neither stereo nor its brightness shows
SHIFT: Final = 4  # fractional bits of the corners that are drawn
NEVER: Final = np.iinfo(np.int64).min


class FreeRanges(NamedTuple):
    """The free floor around the base."""

    free_m: Array  # (SECTORS,) up to which it is known to be free
    hidden_m: Array  # (SECTORS,) from which on something hides it that has come since; inf: nothing


class _Window(NamedTuple):
    """The cells around the robot that are compared, (rows, columns)."""

    cells: tuple[slice, slice]  # of the square
    places: Array  # (rows, columns, 2) m, in the base frame
    distance: Array  # (rows, columns) m
    sector: Counts  # (rows, columns) of the ring


class FreeSpace:
    """Stamps and looks of the cells that were seen to be free, in a square around the robot of bounded size."""

    def __init__(self, reach_m: float, memory_s: float, change_grey: float) -> None:
        """reach_m: farthest distance that is looked up; memory_s: for which a cell stays free; change_grey: of its
        brightness, that shows that something hides it, 0: its brightness is not compared.
        """
        self._memory_ns = round(memory_s * 1e9)
        steps = int(min(reach_m, (MARGIN_CELLS - 2) * CELL_M) / STEP_M)
        self._distances = STEP_M * np.arange(1, steps + 1)
        self._seen_ns = np.full((CELLS, CELLS), NEVER, np.int64)
        self._floor = FloorMemory(CELLS, change_grey)
        self._corner = np.zeros(2, np.int64)  # cell (0, 0) in odom
        self._directions = azimuths()
        self._rest: tuple[Array, int] | None = None  # place [m] where the base stands, and since when

    def clear(self) -> None:
        """Forget everything."""
        self._rest = None
        self._forget(np.ones((CELLS, CELLS), bool))

    def update(self, stamp_ns: int, T_odom_base: Array, seen: Observation, obstacle_m: Array,
               view: Callable[[Array], FloorView]) -> FreeRanges:
        """Add the free ranges of a pair, 0 where nothing was seen; return what is known now.

        obstacle_m (SECTORS,): nearest obstacles of the ring, inf: none; view: returns the looks of the floor at places
        (N, 2) [m] in the base frame.
        """
        centre = T_odom_base[:2, 3] / CELL_M
        self._follow(centre)
        angle = self._directions + math.atan2(T_odom_base[1, 0], T_odom_base[0, 0])
        direction = np.column_stack([np.cos(angle), np.sin(angle)])
        along = self._along(centre, direction)
        self._forget(self._seen_ns < stamp_ns - self._memory_ns)
        # 1. Floor that looks as before, or otherwise.
        window = self._window(T_odom_base)
        looks = self._look(window, view)
        same = self._floor.compare(window.cells, looks.grey, looks.noise_grey)
        self._mark_near(window, looks.in_view, along, obstacle_m, seen.ranges_m)
        # A shadow lies on the floor, which both cameras still see as a plane.
        self._floor.changed[window.cells][window.distance < seen.plane_m[window.sector]] = False
        hidden_m = self._up_to(self._floor.changed[along], math.inf)
        # 2. Floor that counts as free: seen in this pair, or too near to be seen where the base stands.
        unseen = seen.free_m <= 0
        assumed = np.zeros_like(unseen)
        if self._stands(stamp_ns, T_odom_base[:2, 3]) and math.isfinite(seen.floor_from_m):
            assumed = unseen & ~_wide(unseen, ASSUMED_SECTORS)
        reach_m = np.where(assumed, seen.floor_from_m, np.maximum(seen.free_m - END_M, 0.0))
        free = self._drawn(centre, np.minimum(reach_m, hidden_m), direction, unseen & ~assumed)
        x, y = np.floor(centre).astype(np.int64) - self._corner
        free[y, x] = True  # the robot stands there
        free &= ~self._floor.changed
        # What is assumed is not confirmed by looks: a plain wall looks the same as well.
        self._floor.learn(window.cells, looks.grey, free[window.cells] & ~assumed[window.sector])
        free[window.cells] |= same
        self._seen_ns[free] = stamp_ns
        # 3. Memory along the directions; without floor in view that neither stereo nor its brightness shows.
        missed = np.zeros_like(free)
        missed[window.cells] = looks.in_view
        self._forget(missed & ~self._floor.changed & (self._seen_ns < stamp_ns - MISSED_NS))
        known = (self._seen_ns > NEVER) & ~self._floor.changed
        remembered = self._up_to(~known[along], len(self._distances) * STEP_M)
        return FreeRanges(np.minimum(np.maximum(seen.free_m, remembered), hidden_m), hidden_m)

    def _window(self, T_odom_base: Array) -> _Window:
        """Return the cells that are compared, about the robot."""
        middle = np.floor(T_odom_base[:2, 3] / CELL_M).astype(np.int64)
        columns, rows = (slice(at - VIEW_CELLS, at + VIEW_CELLS + 1) for at in (middle - self._corner).tolist())
        cells = middle[:, None] + np.arange(-VIEW_CELLS, VIEW_CELLS + 1)
        x, y = np.meshgrid(*(CELL_M * (cells + 0.5) - T_odom_base[:2, 3:]))
        places = np.stack([x, y], axis=-1) @ T_odom_base[:2, :2]
        turned = (np.arctan2(places[..., 1], places[..., 0]) + math.pi) * (SECTORS / (2 * math.pi))
        return _Window((rows, columns), places, np.hypot(x, y), np.floor(turned).astype(np.intp) % SECTORS)

    def _look(self, window: _Window, view: Callable[[Array], FloorView]) -> FloorView:
        """Return the looks of the window's cells (rows, columns)."""
        seen = view(window.places.reshape(-1, 2))
        in_view = seen.in_view.reshape(window.distance.shape) & (window.distance < VIEW_CELLS * CELL_M)
        grey = np.where(in_view, seen.grey.reshape(in_view.shape), np.float32(np.nan))
        return FloorView(grey.astype(np.float32), in_view, seen.noise_grey)

    def _mark_near(self, window: _Window, in_view: Flags, along: tuple[Counts, Counts], obstacle_m: Array,
                   ranges_m: RangeScan) -> None:
        """Mark the floor nearer than that in view where that is covered, until that is seen or the ring has it.

        ranges_m (SECTORS,): those of this pair.
        """
        square = np.zeros((CELLS, CELLS), bool)
        square[window.cells] = in_view
        shown = square[along]
        first = np.argmax(shown, axis=1)
        nearest = np.minimum(first[:, None] + np.arange(NEAREST_STEPS), len(self._distances) - 1)
        rows, columns = (np.take_along_axis(index, nearest, axis=1) for index in along)
        is_changed = self._floor.changed[rows, columns]
        is_known = np.isfinite(self._floor.grey[rows, columns])
        sees = np.asarray(shown.any(axis=1))
        nearest_m = self._distances[nearest[:, -1]]
        has_obstacle = obstacle_m <= nearest_m
        # What stands there or nearer hides all floor behind it, too: one changed cell of them is the edge of a thing.
        covered = sees & is_changed.all(axis=1) & ~has_obstacle
        # It would hide what is farther away as well: a range that is seen there, by votes, is of a change of the floor.
        covered &= ~(np.isfinite(obstacle_m) & np.isfinite(ranges_m) & (ranges_m > nearest_m))
        is_open = has_obstacle | (sees & (is_known & ~is_changed).all(axis=1))
        near = ~in_view & (window.distance < self._distances[first][window.sector])
        # It stands where something may have stood before, or is the side of a near obstacle; only where there is
        # neither, it may stand anywhere on the way.
        around = np.ones((POSSIBLE_CELLS, POSSIBLE_CELLS), np.uint8)
        possible = cv2.dilate(((self._seen_ns == NEVER) & ~square).astype(np.uint8), around) > 0
        possible |= self._floor.changed & ~square
        stands = possible[along] & (np.arange(len(self._distances)) < first[:, None]) & (self._distances > ROBOT_M)
        side_m = minimum_filter1d(np.where(has_obstacle, obstacle_m, math.inf), 2 * SIDE_SECTORS + 1, mode="wrap")
        from_m = np.minimum(self._up_to(stands, math.inf), side_m - END_M)
        before = window.distance < np.where(np.isfinite(from_m), from_m, 0.0)[window.sector]
        changed = self._floor.changed[window.cells]
        changed[near & covered[window.sector] & ~before] = True
        changed[(near & is_open[window.sector]) | (window.distance < ROBOT_M)] = False

    def _stands(self, stamp_ns: int, position: Array) -> bool:
        """True at the start, and where the base has stood for so long that memory has ended."""
        if self._rest is None:
            self._rest = (position.copy(), stamp_ns - self._memory_ns)
        elif math.dist(position, self._rest[0]) > RESTING_M:
            self._rest = (position.copy(), stamp_ns)
        return stamp_ns - self._rest[1] >= self._memory_ns

    def _drawn(self, centre: Array, free_m: Array, direction: Array, blind: Flags) -> Flags:
        """Return the cells within ranges (SECTORS,) along directions (SECTORS, 2), without those of blind sectors."""
        longest = self._distances[-1]
        drawn = np.zeros((CELLS, CELLS), np.uint8)
        # Near the robot, cells are wider than directions: those that a blind direction touches are left out.
        for reach_m, value in ((np.minimum(free_m, longest), 1), (np.where(blind, longest, 0.0), 0)):
            corners = centre - self._corner - 0.5 + reach_m[:, None] / CELL_M * direction
            cv2.fillPoly(drawn, [np.rint(corners * 2**SHIFT).astype(np.int32)], value, shift=SHIFT)
        return drawn > 0

    def _along(self, centre: Array, direction: Array) -> tuple[Counts, Counts]:
        """Return rows and columns (SECTORS, steps) of the cells along directions (SECTORS, 2)."""
        at = centre - self._corner + self._distances[None, :, None] / CELL_M * direction[:, None, :]
        cells = np.floor(at).astype(np.intp)
        return cells[..., 1], cells[..., 0]

    def _up_to(self, ends: Flags, without_m: float) -> Array:
        """Return the way (SECTORS,) to the first step (SECTORS, steps) that ends it, without_m where none does."""
        return np.where(ends.any(axis=1), STEP_M * np.argmax(ends, axis=1), without_m)

    def _forget(self, cells: Flags) -> None:
        self._seen_ns[cells] = NEVER
        self._floor.forget(cells)

    def _follow(self, centre: Array) -> None:
        """Move the square where the robot comes near its border."""
        at = np.floor(centre).astype(np.int64) - self._corner
        if ((at >= MARGIN_CELLS) & (at < CELLS - MARGIN_CELLS)).all():
            return
        shift = at - CELLS // 2
        gone = np.ones((CELLS, CELLS), bool)
        x, y = np.clip(shift, -CELLS, CELLS).tolist()
        gone[max(-y, 0) : CELLS - max(y, 0), max(-x, 0) : CELLS - max(x, 0)] = False
        for layer in (self._seen_ns, self._floor.grey, self._floor.changed):
            layer[:] = np.roll(layer, (-y, -x), axis=(0, 1))
        self._forget(gone)
        self._corner += shift


def _wide(marked: Flags, least: int) -> Flags:
    """Return the marked sectors that stand in a run of at least so many, around the full turn."""
    begins = marked.copy()
    for shift in range(1, least):
        begins &= np.roll(marked, -shift)
    return np.asarray(np.logical_or.reduce([np.roll(begins, shift) for shift in range(least)]))
