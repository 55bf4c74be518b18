"""Cells nearer than the nearest floor in view, which pairs do not show: they are judged by what is seen behind them."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from omnid.core.obstacles import near_field_kernels as kernels
from omnid.core.obstacles.cell_kernels import FLOOR, FREE_ODDS, SURFACE, TAKEN_ODDS
from omnid.core.obstacles.usual_floor import LEAST_FRESH, NARROW_CELLS, Watch

Array = NDArray[np.float64]
Floats = NDArray[np.float32]

FLOORS: Final = slice(FLOOR, SURFACE)  # layers of the odds: all that say a cell is floor
Flags = NDArray[np.bool_]

# Sectors on either side that see past a place which is not in view itself. Measured: 2 to 4 are alike.
PAST_SECTORS: Final = 3
# Cells beyond the nearest floor in view, one of which must show floor or a surface, because at the foot of a wall some
# show neither. Before a viewpoint 0.9 m high, what stands 0.5 m away and is higher than 0.6 m hides all of them.
BEHIND_CELLS: Final = 7
# Evidence of a pair by which a surface is surely in view; measured: a box of 1.5 m has 15 and more 0.55 to 0.8 m away,
# one of 0.35 m 4.5 at most (by hand, in a rendered room of 512 px, development seed 1); bare floor has 0.15 in the
# mean.
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
        part, near = _about(eye, nearest, window)
        out_of_view, shown = ~in_view[near], surface[near]
        range_m = self._range_m(part, eye)
        seen_m = self._seen_m[part]
        np.minimum(seen_m, range_m, out=seen_m, where=(shown >= SEEN_SURFACE) & out_of_view)
        would_show = (shown <= 0) & out_of_view & (range_m >= seen_m - self._cell_m)
        if would_show.any():
            found[near] = would_show & past()[part]
        return found

    def surely_shown(
        self, window: tuple[slice, slice], surface: Floats, in_view: Flags, eye: Array, nearest: int
    ) -> Flags:
        """Return the cells (H, W) too near to show floor in which a pair surely shows a surface."""
        found = np.zeros(self._seen_m.shape, bool)
        part, near = _about(eye, nearest, window)
        found[part] = (surface[near] >= SEEN_SURFACE) & ~in_view[near]
        return found

    def _range_m(self, part: tuple[slice, slice], eye: Array) -> Floats:
        """Return the ranges [m] of cells in a part of the square."""
        return np.asarray(self._cell_m * np.hypot(self._x[part] - eye[0], self._y[part] - eye[1]), np.float32)

    def seen_past(self, odds: Floats, watch: Watch, eye: Array, nearest: int) -> Flags:
        """Return the cells (H, W) behind which the nearest floor in view is watched, in some sectors side by side.

        odds (5, H, W): log-odds of all layers.
        """
        floor_behind, _ = self._view_past(odds, watch, eye, nearest)
        return self._marked(eye, np.where(_side_by_side(floor_behind), nearest, 0))

    def clear_seen_past(self, odds: Floats, watch: Watch, eye: Array, nearest: int) -> None:
        """End the flood too near to be seen where something behind it is watched: a person would hide that.

        Behind it is the floor in view nearest to it, or a surface, such as the walls of a corridor. Between two such
        directions nothing else may stand that is wider than the way between them.
        """
        if not nearest or not watch.flooded.any():
            return
        floor_behind, clear = self._view_past(odds, watch, eye, nearest)
        past = _side_by_side(floor_behind | (clear < nearest + BEHIND_CELLS))
        ways = np.where(past, np.minimum(clear, nearest + 2), 0)
        ways = _over_narrow(ways, int(NARROW_CELLS / nearest * len(ways) / math.tau))
        ended = self._marked(eye, ways) & (watch.flooded > 0)
        odds[FLOORS, ended] = FREE_ODDS + 1
        watch.flooded[ended] = 0

    def _view_past(self, odds: Floats, watch: Watch, eye: Array, nearest: int) -> tuple[Flags, NDArray[np.int32]]:
        """Return where (SECTORS,) floor is watched behind the nearest in view; the cells before a watched surface."""
        floor_behind, clear = np.empty(len(self._directions), np.uint8), np.empty(len(self._directions), np.int32)
        ways = np.array([nearest, nearest + BEHIND_CELLS])
        least = np.array([LEAST_FRESH, FREE_ODDS, TAKEN_ODDS], np.float32)
        layers = odds[FLOOR], odds[SURFACE], watch.evidence
        kernels.view_past(*layers, eye, self._directions, ways, least, floor_behind, clear)
        return floor_behind > 0, clear

    def _marked(self, eye: Array, ways: NDArray[np.integer[Any]]) -> Flags:
        """Return the cells (H, W) within ways (SECTORS,) [cells] along the directions."""
        cells = np.zeros(self._seen_m.shape, np.uint8)
        kernels.mark(eye, self._directions, ways.astype(np.int32), cells)
        return cells.view(np.bool_)


def _about(eye: Array, reach: int, window: tuple[slice, slice]) -> tuple[tuple[slice, slice], tuple[slice, slice]]:
    """Return the part of a square, and of a window of it, within a reach of the viewpoint (2,), all in cells."""
    begin = np.floor(eye).astype(int) - reach
    rows, columns = (
        slice(max(at, side.start), min(at + 2 * reach + 1, side.stop))
        for at, side in zip(begin[::-1].tolist(), window, strict=True)
    )
    inside = [slice(a.start - b.start, a.stop - b.start) for a, b in zip((rows, columns), window, strict=True)]
    return (rows, columns), (inside[0], inside[1])


def lose_before(lost: Floats, near: Floats, eye: Array, azimuths: Array, nearest: int) -> None:
    """Change the log-odds `lost` (H, W) that visible floor loses, in cells too near to be seen.

    What hides the nearest floor in view may stand anywhere before it; as the base moves, directions cross there. Of the
    directions through a cell the most hidden one counts. near (N,): log-odds that something hides it, along azimuths
    (N,); eye (2,): viewpoint in cells; nearest: range of the nearest floor in view in cells.
    """
    if nearest >= 2:
        directions = np.column_stack([np.cos(azimuths), np.sin(azimuths)])
        kernels.lose_before(eye, directions, nearest, near, lost)


def _over_narrow(ways: NDArray[np.integer[Any]], count: int) -> NDArray[np.integer[Any]]:
    """Return ways (SECTORS,) with runs of at most so many zeros replaced by the shorter way beside them."""
    found, ended = ways.copy(), np.flatnonzero(ways)
    for begin, end in zip(ended, [*ended[1:], *(ended[:1] + len(ways))], strict=True):
        if 1 < end - begin <= count + 1:
            found[np.arange(begin + 1, end) % len(ways)] = min(ways[begin], ways[end % len(ways)])
    return found


def _side_by_side(flags: Flags) -> Flags:
    """Return the flags (SECTORS,) that stand with PAST_SECTORS others on either side."""
    around = np.concatenate([flags[-PAST_SECTORS:], flags, flags[:PAST_SECTORS]])
    found = flags.copy()
    for shift in range(2 * PAST_SECTORS + 1):
        found &= around[shift : shift + len(flags)]
    return found
