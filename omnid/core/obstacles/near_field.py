"""Cells nearer than the nearest floor in view, which pairs do not show: they are judged by what is seen behind them."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from omnid.core.obstacles.grid_layers import FLOOR, FLOORS, FREE_ODDS, SURFACE, TAKEN_ODDS
from omnid.core.obstacles.watch import Watch

Array = NDArray[np.float64]
Floats = NDArray[np.float32]
Flags = NDArray[np.bool_]
Indices = NDArray[np.intp]

PAST_SECTORS: Final = 3  # Sectors on either side that must see past a place too near to be seen.
# Cells beyond the nearest floor in view, one of which must show floor or a surface: at the foot of a wall some show
# neither. Before a viewpoint 0.9 m high, what stands 0.5 m away and is higher than 0.6 m hides all of them.
BEHIND_CELLS: Final = 7
# Evidence of a pair by which a surface is surely in view: a box of 1.5 m has 15 and more 0.55 to 0.8 m away, one of
# 0.35 m 4.5 at most (by hand, in a rendered room of 512 px, development seed 1); bare floor has 0.15 in the mean.
SEEN_SURFACE: Final = np.float32(5.0)


class NearField:
    """Judges cells of a square by the view past them; keeps from how near their surfaces were seen."""

    def __init__(self, cells: int, cell_m: float, directions: Array) -> None:
        """cells: side of the square; cell_m: side of a cell; directions (SECTORS, 2) around the viewpoint."""
        self._cell_m, self._directions = cell_m, directions
        y, x = np.indices((cells, cells)) + 0.5
        self._x, self._y = x.astype(np.float32), y.astype(np.float32)
        self._seen_m = np.full((cells, cells), np.inf, np.float32)  # least range at which a surface was surely in view

    @property
    def layers(self) -> tuple[tuple[NDArray[Any], float], ...]:
        """The layers (cells, cells), and what each holds where nothing is known."""
        return ((self._seen_m, np.inf),)

    def within(self, eye: Array, radius: float) -> Flags:
        """Return the cells (cells, cells) within a radius of the viewpoint, both in cells."""
        return np.asarray(np.hypot(self._x - eye[0], self._y - eye[1]) < radius)

    def keep(self, before: NearField, kept: Flags) -> None:
        """Take over from how near surfaces were seen, in cells (cells, cells)."""
        self._seen_m[kept] = before._seen_m[kept]

    def forget(self, bare: Flags) -> None:
        """Forget from how near surfaces were seen, in cells (cells, cells) that show none: others may come there."""
        self._seen_m[bare] = np.inf

    def lose_before(self, lost: Floats, eye: Array, nearest: int) -> None:
        """Change the log-odds `lost` (H, W) that visible floor loses, in cells too near to be seen: as behind them.

        What hides the nearest floor in view may stand anywhere before it; as the base moves, directions cross there.
        eye (2,): viewpoint in cells; nearest: range of the nearest floor in view in cells.
        """
        if nearest < 2:
            return
        rows, columns = self._cells_along(eye, nearest + 2)
        behind = lost[rows[:, nearest:], columns[:, nearest:]].mean(axis=1)
        near = rows[:, : nearest - 1], columns[:, : nearest - 1]
        # Of the directions through a cell the most hidden one counts.
        lost[near] = -np.inf
        np.maximum.at(lost, near, np.broadcast_to(behind[:, None], near[0].shape))

    def gone(
        self,
        window: tuple[slice, slice],
        surface: Floats,
        in_view: Flags,
        past: Callable[[], Flags],
        eye: Array,
        nearest: int,
    ) -> Flags:
        """Return the cells of a window in which a surface would be in view, shows nothing, and hides nothing.

        The lower end of the view falls with the range: what was seen from somewhere is seen from all places that are
        not nearer. So what is low and was seen from farther away stays. surface, in_view: of the window, evidence of a
        pair, and where floor can be seen; past: returns the cells (H, W) behind which floor is seen.
        """
        found = np.zeros(surface.shape, bool)
        begin = np.floor(eye).astype(int) - nearest
        rows, columns = (
            slice(max(at, side.start), min(at + 2 * nearest + 1, side.stop))
            for at, side in zip(begin[::-1].tolist(), window, strict=True)
        )
        near = tuple(slice(a.start - b.start, a.stop - b.start) for a, b in zip((rows, columns), window, strict=True))
        out_of_view, shown = ~in_view[near], surface[near]
        range_m = self._cell_m * np.hypot(self._x[rows, columns] - eye[0], self._y[rows, columns] - eye[1])
        seen_m = self._seen_m[rows, columns]
        np.minimum(seen_m, range_m, out=seen_m, where=(shown >= SEEN_SURFACE) & out_of_view)
        would_show = (shown <= 0) & out_of_view & (range_m >= seen_m - self._cell_m)
        if would_show.any():
            found[near] = would_show & past()[rows, columns]
        return found

    def seen_past(self, floor_odds: Floats, watch: Watch, eye: Array, nearest: int) -> Flags:
        """Return the cells (H, W) behind which the nearest floor in view is watched, in some sectors side by side."""
        found = np.zeros(floor_odds.shape, bool)
        rows, columns = self._cells_along(eye, nearest + BEHIND_CELLS)
        far = rows[:, nearest - 1 :], columns[:, nearest - 1 :]
        past = _side_by_side(np.any(watch.watched[far] & (floor_odds[far] > FREE_ODDS), axis=1))
        found[rows[past, :nearest], columns[past, :nearest]] = True
        return found

    def clear_seen_past(self, odds: Floats, watch: Watch, eye: Array, nearest: int) -> None:
        """End the flood too near to be seen where something behind it is watched: a person would hide that.

        Behind it is the floor in view nearest to it, or a surface, such as the walls of a corridor.
        """
        if not nearest or not watch.flooded.any():
            return
        steps = nearest + 2
        rows, columns = self._cells_along(eye, nearest + BEHIND_CELLS)
        watched = watch.watched[rows, columns]
        surface = np.logical_or.accumulate(watched & (odds[SURFACE][rows, columns] > TAKEN_ODDS), axis=1)
        floor = watched & (odds[FLOOR][rows, columns] > FREE_ODDS)
        past = _side_by_side(floor[:, nearest - 1 :].any(axis=1) | surface[:, -1])
        chosen = past[:, None] & ~surface[:, :steps]
        cells = rows[:, :steps][chosen], columns[:, :steps][chosen]
        flooded = watch.flooded[cells] > 0
        odds[FLOORS, *cells] = np.where(flooded, np.float32(FREE_ODDS + 1), odds[FLOORS, *cells])
        watch.flooded[cells] = 0

    def _cells_along(self, eye: Array, steps: int) -> tuple[Indices, Indices]:
        """Return the rows and columns (SECTORS, steps) of the first cells along all directions."""
        ways = eye + np.arange(1, steps + 1)[None, :, None] * self._directions[:, None]
        columns, rows = np.moveaxis(np.floor(ways).astype(np.intp), -1, 0)
        return rows, columns


def _side_by_side(flags: Flags) -> Flags:
    """Return the flags (SECTORS,) that stand with PAST_SECTORS others on either side."""
    return np.asarray(
        np.logical_and.reduce([np.roll(flags, shift) for shift in range(-PAST_SECTORS, PAST_SECTORS + 1)])
    )
