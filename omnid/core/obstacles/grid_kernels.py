"""Compiled loop of the obstacle grid: rays gathered by cells."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from omnid.core.compiled import compiled, inner

Floats = NDArray[np.float32]
Doubles = NDArray[np.float64]
Bytes = NDArray[np.uint8]

CELL_M = 0.05
THIN_M = 0.035  # width of the thinnest obstacle. With 0.03, by trial, more bases stood on polished floors.
RATIO, VIEW, SURFACE = 0, 1, 2  # layers of what `gather` writes
UNSEEN, IN_VIEW, SEEN_PAST, HIDDEN, MOSTLY_PAST = 0, 1, 2, 3, 4  # states of a cell in a pair
OUT_OF_VIEW, IS_PAST, IS_HIDDEN = 0, 1, 2  # states of the nearest floor in view of a direction
MOST_BESIDE = 60  # directions of a cell on either side, that of one next to the viewpoint
HANGS = 0.4, 1.5  # ratio of a surface that noise reaches, and the most that one direction counts beyond it


@inner
def bin_at(ends: Doubles, at_1m: float, range_m: float) -> int:
    """Return the bin of a range; ends (N + 1,): that of half disparities, from near to far; -1: nearer, N: farther."""
    n = math.ceil(2.0 * (at_1m / ends[0] - at_1m / range_m) - 1e-9) - 1 if range_m > 0.0 else -1
    return -1 if n < 0 else (n if n < len(ends) - 1 else len(ends) - 1)


@compiled(
    "(f4[:, ::1], f4[:, ::1], f4[:, ::1], u1[::1], f8[::1], f8, f8[::1], f8, f8, f4[:, :, ::1], u1[:, ::1])",
    writes=("cells", "states"),
)
def gather(
    ratios: Floats,
    view: Floats,
    surface: Floats,
    near: Bytes,
    ends: Doubles,
    at_1m: float,
    eye: Doubles,
    turn_rad: float,
    reach_m: float,
    cells: Floats,
    states: Bytes,
) -> None:
    """Write the evidence (3, N, N) of cells, and their states (N, N).

    ratios, view, surface (D, K): of a RayBelief; near (D,): whether the nearest floor in view is past, hidden or none;
    ends (K + 1,): ranges of the bins; at_1m: disparity at 1 m. eye (2,): x and y of the viewpoint in cells; turn_rad:
    azimuth of the x axis of the grid about it. A cell is as taken as the most taken of the bins and directions in it: a
    pole fills no cell.
    """
    directions, bins = ratios.shape
    by_angle, row = directions / math.tau, np.empty(2 * MOST_BESIDE + 2)
    cells[:] = 0.0
    states[:] = UNSEEN
    for i in range(cells.shape[1]):
        for j in range(cells.shape[2]):
            x, y = j + 0.5 - eye[0], i + 0.5 - eye[1]
            r = CELL_M * math.hypot(x, y)
            if r > reach_m or r < 0.5 * CELL_M:
                continue
            at = (math.pi - turn_rad - math.atan2(y, x)) * by_angle - 0.5
            half = min(0.5 * CELL_M / r * by_angle, MOST_BESIDE)
            first, last = math.ceil(at - half), math.floor(at + half)
            if last < first:
                first = last = round(at)
            count = last - first + 1
            begin, end = bin_at(ends, at_1m, r - 0.5 * CELL_M), bin_at(ends, at_1m, r + 0.5 * CELL_M)
            if begin < 0:
                # Too near to be seen: known by what is seen past it. The thinnest thing would hide so many directions.
                hidden, past = 0, 0
                for u in range(first, last + 1):
                    hidden += near[u % directions] == IS_HIDDEN
                    past += near[u % directions] == IS_PAST
                if hidden >= min(0.6 * THIN_M / r * by_angle, count):
                    states[i, j] = HIDDEN
                elif past + hidden == count:
                    states[i, j] = SEEN_PAST if hidden == 0 else MOSTLY_PAST
                continue
            if end >= bins:
                continue
            # A thin thing hides so many directions together: their mean counts, as one alone is noise.
            run = max(min(round(THIN_M / r * by_angle), count), 1)
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
                total += min(max(shown - HANGS[0], 0.0), HANGS[1])
                row[u - first] = taken
                together += taken
                if u - first >= run:
                    together -= row[u - first - run]
                if u - first >= run - 1:
                    most = max(most, together / run)
            if seen > 0:
                cells[RATIO, i, j], cells[VIEW, i, j], cells[SURFACE, i, j] = most, least, total / count
                states[i, j] = IN_VIEW
