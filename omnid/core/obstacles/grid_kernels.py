"""Compiled loops of the belief grid: rays gathered by cells, and ways along directions.

Squares (H, W) hold cells, windows (N, N) parts of them. Steps are those of belief_grid.py.
"""

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
    "(f4[:, ::1], f4[:, ::1], f4[:, ::1], u1[::1], f8[::1], f8, f8[::1], f8, f8, f8, f4[:, :, ::1], u1[:, ::1])",
    writes=("cells", "states"),
)
def gather(
    ratios: Floats,
    view: Floats,
    surface: Floats,
    near: Bytes,
    ends: Doubles,
    at_1m: float,
    origin: Doubles,
    cell_m: float,
    reach_m: float,
    thin_m: float,
    cells: Floats,
    states: Bytes,
) -> None:
    """Write the evidence (3, N, N) of cells, and their states (N, N).

    ratios, view, surface (D, K): of a RayBelief; near (D,): 1 where the nearest floor in view is seen, 2 where
    something hides it, 0 where nothing is in view; ends (K + 1,): ranges of the bins; at_1m: disparity at 1 m.
    origin (4,): place of the middle of cell (0, 0) about the viewpoint, cosine and sine of the axes there; thin_m:
    width of the thinnest thing.
    A cell is as taken as the most taken of the bins and directions in it: a pole fills no cell.
    """
    directions, bins = ratios.shape
    by_angle, row = directions / math.tau, np.empty(2 * MOST_BESIDE + 2)
    for i in range(cells.shape[1]):
        for j in range(cells.shape[2]):
            cells[RATIO, i, j] = cells[VIEW, i, j] = cells[SURFACE, i, j] = 0.0
            states[i, j] = UNSEEN
            x = origin[0] + cell_m * (origin[2] * j - origin[3] * i)
            y = origin[1] + cell_m * (origin[3] * j + origin[2] * i)
            r = math.sqrt(x * x + y * y)
            if r > reach_m or r < 0.5 * cell_m:
                continue
            at = (math.pi - math.atan2(y, x)) * by_angle - 0.5
            half = min(0.5 * cell_m / r * by_angle, MOST_BESIDE)
            first, last = math.ceil(at - half), math.floor(at + half)
            if last < first:
                first = last = round(at)
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


@compiled("(f4[:, ::1], f8[::1], f8[::1], f8, f8[::1], f8[::1], f8[::1])", writes=("hit", "sigma", "free"))
def ways(
    taken: Floats, origin: Doubles, angles: Doubles, risk: float, hit: Doubles, sigma: Doubles, free: Doubles
) -> None:
    """Write, along directions (N,), the range of the first thing and its sigma, NaN without one, and the way up to
    which the probability of a thing is at most `risk`.

    taken (H, W): probability of a thing in a cell, 2 where nothing is known. origin (4,): place in cells, longest way
    [m], size of a cell [m].
    """
    height, width = taken.shape
    cell, longest = origin[3], origin[2]
    for n in range(len(angles)):
        dx, dy = math.cos(angles[n]) / cell, math.sin(angles[n]) / cell
        hit[n], sigma[n], free[n] = np.nan, np.nan, longest
        clear, ended, inside = 1.0, False, False
        weight, mean, square = 0.0, 0.0, 0.0
        r, step = 0.5 * cell, cell
        while r < longest:
            i, j = math.floor(origin[1] + r * dy), math.floor(origin[0] + r * dx)
            if i < 0 or j < 0 or i >= height or j >= width:
                if not ended:
                    free[n], ended = r - 0.5 * cell, True
                break
            value = taken[i, j]
            if not ended:
                clear *= 1.0 - min(value, 1.0)
                if 1.0 - clear > risk:
                    free[n], ended = r - 0.5 * cell, True
            if 0.5 < value <= 1.0:
                inside = True
                weight += value
                mean += value * r
                square += value * r * r
            elif inside:
                break
            r += step
        if inside:
            hit[n] = mean / weight
            sigma[n] = math.sqrt(max(square / weight - hit[n] * hit[n], 0.0) + cell * cell / 12.0)


@compiled("(f4[:, ::1], u1[:, ::1], u1[:, ::1], f8[::1], f8[::1], f8)", writes=("flooded",))
def too_near(taken: Floats, states: Bytes, flooded: Bytes, origin: Doubles, angles: Doubles, reach_m: float) -> None:
    """Set the cells (H, W) to 1 on ways too near to be seen, behind which floor is hidden and nothing is known that
    hides it.

    taken: as for `ways`; states: of `gather`. origin (3,): viewpoint in cells, size of a cell [m].
    """
    height, width = taken.shape
    cell, count = origin[2], len(angles)
    explained = np.full(count, -1.0)
    for n in range(count):
        dx, dy, r = math.cos(angles[n]) / cell, math.sin(angles[n]) / cell, cell
        while r < reach_m + 3.0 * cell and explained[n] < 0.0:
            i, j = math.floor(origin[1] + r * dy), math.floor(origin[0] + r * dx)
            if i < 0 or j < 0 or i >= height or j >= width:
                break
            if 0.3 < taken[i, j] <= 1.0:
                explained[n] = r
            r += 0.5 * cell
    for n in range(count):
        dx, dy, r = math.cos(angles[n]) / cell, math.sin(angles[n]) / cell, cell
        end = -1.0
        for other in range(n - 2, n + 3):
            end = max(end, explained[other % count])
        while r < reach_m and end < 0.0:
            i, j = math.floor(origin[1] + r * dy), math.floor(origin[0] + r * dx)
            if i < 0 or j < 0 or i >= height or j >= width:
                break
            if states[i, j] == HIDDEN:
                flooded[i, j] = 1
            r += 0.5 * cell


@compiled("(u1[:, ::1], u1[:, ::1], f8[::1], f8[::1], f8, f8, f8[::1])", writes=("ranges",))
def first_changed(
    taken: Bytes, lately: Bytes, origin: Doubles, angles: Doubles, width_m: float, at_1m: float, ranges: Doubles
) -> None:
    """Write the ranges (N,) from the viewpoint to what has come onto floor along directions (N,), NaN: nothing has.

    taken, lately (H, W): 1 where a cell is taken, and where it was free a short while ago. What comes stands before
    floor that was free for width_m, and by the noise of stereo, three sigmas of a disparity. origin (4,): viewpoint in
    cells, longest way [m], size of a cell [m]; at_1m: disparity at 1 m.
    """
    height, width = taken.shape
    cell = origin[3]
    for n in range(len(angles)):
        dx, dy = math.cos(angles[n]) / cell, math.sin(angles[n]) / cell
        ranges[n] = np.nan
        r, begin, end = cell, -1.0, 0.0
        while r < origin[2]:
            i, j = math.floor(origin[1] + r * dy), math.floor(origin[0] + r * dx)
            if i < 0 or j < 0 or i >= height or j >= width:
                break
            if begin < 0.0 and taken[i, j]:
                begin, end = r, r + width_m + 1.5 * r * r / at_1m
            if begin >= 0.0:
                if not lately[i, j]:
                    break
                if r >= end:
                    ranges[n] = begin
                    break
            r += 0.5 * cell
