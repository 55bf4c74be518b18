"""Compiled loop of the obstacle grid: rays gathered by cells."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from omnid.core.compiled import compiled, inner

Floats = NDArray[np.float32]
Doubles = NDArray[np.float64]
Bytes = NDArray[np.uint8]

RATIO, VIEW, SURFACE = 0, 1, 2  # layers of what `gather` writes
UNSEEN, IN_VIEW, SEEN_PAST, HIDDEN, MOSTLY_PAST = 0, 1, 2, 3, 4  # states of a cell in a pair
MOST_BESIDE = 60  # directions of a cell on either side, that of one next to the viewpoint


@inner
def bin_at(ends: Doubles, at_1m: float, range_m: float) -> int:
    """Return the bin of a range; ends (N + 1,): that of half disparities, from near to far; -1: nearer, N: farther."""
    n = math.ceil(2.0 * (at_1m / ends[0] - at_1m / range_m) - 1e-9) - 1 if range_m > 0.0 else -1
    return -1 if n < 0 else (n if n < len(ends) - 1 else len(ends) - 1)


@compiled(
    "(f4[:, ::1], f4[:, ::1], f4[:, ::1], u1[::1], f8[::1], f8, f4[:, ::1], f4[:, ::1], f8, f8, f8, f4[:, :, ::1],"
    " u1[:, ::1])",
    writes=("cells", "states"),
)
def gather(
    ratios: Floats,
    view: Floats,
    surface: Floats,
    near: Bytes,
    ends: Doubles,
    at_1m: float,
    ranges: Floats,
    at: Floats,
    cell_m: float,
    reach_m: float,
    thin_m: float,
    cells: Floats,
    states: Bytes,
) -> None:
    """Write the evidence (3, N, N) of cells, and their states (N, N).

    ratios, view, surface (D, K): of a RayBelief; near (D,): 1 where the nearest floor in view is seen, 2 where
    something hides it, 0 where nothing is in view; ends (K + 1,): ranges of the bins; at_1m: disparity at 1 m.
    ranges [m], at (N, N): ranges and directions of the cells, from the viewpoint; thin_m: width of the thinnest thing.
    A cell is as taken as the most taken of the bins and directions in it: a pole fills no cell.
    """
    directions, bins = ratios.shape
    by_angle, row = directions / math.tau, np.empty(2 * MOST_BESIDE + 2)
    for i in range(cells.shape[1]):
        for j in range(cells.shape[2]):
            cells[RATIO, i, j] = cells[VIEW, i, j] = cells[SURFACE, i, j] = 0.0
            states[i, j] = UNSEEN
            r = float(ranges[i, j])
            if r > reach_m or r < 0.5 * cell_m:
                continue
            half = min(0.5 * cell_m / r * by_angle, MOST_BESIDE)
            first, last = math.ceil(at[i, j] - half), math.floor(at[i, j] + half)
            if last < first:
                first = last = round(at[i, j])
            begin, end = bin_at(ends, at_1m, r - 0.5 * cell_m), bin_at(ends, at_1m, r + 0.5 * cell_m)
            if begin < 0:
                # Too near to be seen: known by what is seen past it.
                hidden, past = 0, 0
                for u in range(first, last + 1):
                    state = near[u % directions]
                    hidden += state == 2
                    past += state == 1
                # The thinnest thing there would hide so many directions.
                if hidden >= min(0.6 * thin_m / r * by_angle, last - first + 1.0):
                    states[i, j] = HIDDEN
                elif past + hidden == last - first + 1:
                    states[i, j] = SEEN_PAST if hidden == 0 else MOSTLY_PAST
                continue
            if end >= bins:
                continue
            # A thin thing hides so many directions together: their mean counts, as one alone is noise.
            run = max(min(round(thin_m / r * by_angle), last - first + 1), 1)
            most, least, total, together, seen = -99.0, 1.0, 0.0, 0.0, 0
            for u in range(first, last + 1):
                at_u, taken, shown, is_seen = u % directions, 0.0, 0.0, False
                for k in range(begin, end + 1):
                    if view[at_u, k] > 0:
                        taken = max(taken, ratios[at_u, k]) if is_seen else ratios[at_u, k]
                        is_seen = True
                    shown = max(shown, surface[at_u, k])
                    least = min(least, view[at_u, k])
                seen += is_seen
                total += min(max(shown - 0.4, 0.0), 1.5)
                row[u - first] = taken
                together += taken
                if u - first >= run:
                    together -= row[u - first - run]
                if u - first >= run - 1:
                    most = max(most, together / run)
            if seen == 0:  # out of sight, as beside a sector
                continue
            cells[RATIO, i, j], cells[VIEW, i, j] = most, least
            cells[SURFACE, i, j] = total / (last - first + 1)
            states[i, j] = IN_VIEW
