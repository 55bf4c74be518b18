"""Compiled loops of the obstacle grid: evidence of directions and ranges, gathered by cells; ways along directions."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from omnid.core.compiled import compiled, inner

Floats = NDArray[np.float32]
Doubles = NDArray[np.float64]
Bytes = NDArray[np.uint8]


LANES = 64  # Cells of a row that are computed at once, because the compiler makes vector instructions of a known count.
# Where the numbers of those cells begin in `found` of `places`: multiples of LANES, because it holds so many of each
# kind.
X, Y, RANGE, AT, HALF, NEAR, FAR, LAST_SURFACE, FIRST_SURFACE = 0, 64, 128, 192, 256, 320, 384, 448, 512
PLACES = 576
# Directions by which a cell is off a border of one, so that `azimuth` is enough: its 2e-8 rad are 2e-6 directions.
SURE = 1e-5
FLOOR, ABOVE, BELOW, SURFACE = 0, 1, 2, 3  # numbers of a direction and disparity in the table


@inner
def azimuth(x: float, y: float) -> float:
    """Return atan2(y, x) within 2e-8 (Abramowitz and Stegun 1964, 4.4.49), without branches."""
    a, b = abs(x), abs(y)
    share = min(a, b) / max(a, b)
    z = share * share
    angle = z * (z * (0.0429096138 + z * (-0.0161657367 + z * 0.0028662257)) - 0.0752896400)
    angle = share * (1.0 + z * (z * (0.1999355085 + z * (z * (0.1065626393 + angle) - 0.1420889944)) - 0.3333314528))
    angle = 0.5 * math.pi - angle if b > a else angle
    angle = math.pi - angle if x < 0.0 else angle
    return -angle if y < 0.0 else angle


@inner
def places(i: int, begin: int, origin: Doubles, scale: tuple[float, float, float, float], found: Doubles) -> None:
    """Write where the cells of row i from `begin` on are among directions and disparities.

    scale: disparity at 1 m, last disparity, size of a cell [m], directions in a radian. found (PLACES,): x, y and
    range [m]; direction, by `azimuth`, and half a cell in directions; disparities of the near and the far end of the
    cell, and of the ends of what a surface in it may have.
    """
    at_1m, last_bin, cell_m, by_angle = scale
    x0, y0, c, s, lean_x, lean_y = origin[0], origin[1], origin[2], origin[3], origin[4], origin[5]
    for n in range(LANES):
        j = np.float64(np.int32(begin + n))
        x = x0 + cell_m * (c * j - s * i)
        y = y0 + cell_m * (s * j + c * i)
        r = math.sqrt(x * x + y * y)
        # A surface counts in the cell of its foot, whichever of its heights is seen.
        lean = (lean_x * x + lean_y * y) / r
        nearest = r - 0.5 * cell_m - (lean if lean > 0.0 else 0.0)
        farthest = r + 0.5 * cell_m - (lean if lean < 0.0 else 0.0)
        last_surface = at_1m / nearest + 0.5 if nearest > 0.0 else last_bin
        found[X + n], found[Y + n], found[RANGE + n] = x, y, r
        found[AT + n] = (math.pi - azimuth(x, y)) * by_angle - 0.5
        found[HALF + n] = 0.5 * cell_m / r * by_angle
        found[NEAR + n] = min(np.floor(at_1m / (r - 0.5 * cell_m)), last_bin)
        found[FAR + n] = np.floor(at_1m / (r + 0.5 * cell_m))
        found[LAST_SURFACE + n] = min(np.floor(last_surface), last_bin)
        found[FIRST_SURFACE + n] = np.floor(at_1m / farthest + 0.5)


@inner
def directions(x: float, y: float, at: float, half: float, by_angle: float) -> tuple[int, int]:
    """Return the first and the last direction of a cell at x, y [m]; at, half: of `places`."""
    first, last = math.ceil(at - half), math.floor(at + half)
    before, after = first - (at - half), (at + half) - last
    if last < first or min(before, after) < SURE or max(before, after) > 1.0 - SURE:
        at = (math.pi - math.atan2(y, x)) * by_angle - 0.5
        first, last = math.ceil(at - half), math.floor(at + half)
        if last < first:
            first = last = round(at)
    return first, last


@inner
def evidence_table(floor: Floats, surface: Floats, level: Floats, table: Floats) -> None:
    """Write what `gather` adds up (W, K, 4), in the order in which it reads: a surface as its likelihood."""
    for k in range(floor.shape[0]):
        for u in range(floor.shape[1]):
            table[u, k, FLOOR], table[u, k, ABOVE], table[u, k, BELOW] = floor[k, u], level[0, k, u], level[1, k, u]
            table[u, k, SURFACE] = math.exp(surface[k, u]) if surface[k, u] != 0.0 else 1.0


@inner
def mean_surface(table: Floats, ends: tuple[int, int], disparities: tuple[int, int]) -> float:
    """Return the log of the mean likelihood of a surface in a cell: `log mean exp` of the evidence.

    table (W, K, 4): of `evidence_table`; ends: first and last direction; disparities: first and last.
    """
    width, likelihood = len(table), 0.0
    for u in range(ends[0], ends[1] + 1):
        at_u = wrapped(u, width)
        for k in range(disparities[0], disparities[1] + 1):
            likelihood += table[at_u, k, SURFACE]
    count = (ends[1] - ends[0] + 1) * (disparities[1] - disparities[0] + 1)
    return math.log(likelihood / count) if likelihood != count else 0.0


@inner
def wrapped(u: int, width: int) -> int:
    """Return the direction u, which may lie up to a turn outside, as an index of the table."""
    return u + width if u < 0 else (u - width if u >= width else u)


@compiled("(f4[:, ::1], f4[:, ::1], f4[:, :, ::1], f8[::1], f8, f8, f8, f8, f4[:, :, ::1])", writes=("cells",))
def gather(
    floor: Floats,
    surface: Floats,
    level: Floats,
    origin: Doubles,
    at_1m: float,
    cell_m: float,
    reach_m: float,
    thin_m: float,
    cells: Floats,
) -> None:
    """Write the evidence (5, N, N) of cells: floor where it is weakest, NaN where none can be seen; the means of the
    floor against planes above and below it; an upright surface anywhere in it; the mean of the floor.

    floor, surface (K, W), level (2, K, W): log-likelihood ratios by disparity and direction, NaN where nothing is
    compared. origin (6,): place of the middle of cell (0, 0) in the frame of the columns, cosine and sine of its axes
    there, and by how much [m] a surface at the viewpoint's height appears nearer than its foot along x and y, as the
    rig leans. at_1m: disparity at 1 m; reach_m: farther cells are left out; thin_m: width of the thinnest obstacle,
    whose directions are judged together.
    """
    bins, width = floor.shape
    table, found = np.empty((width, bins, 4), np.float32), np.empty(PLACES, np.float64)
    evidence_table(floor, surface, level, table)
    by_angle = width / math.tau
    scale = at_1m, bins - 1.0, cell_m, by_angle
    for i in range(cells.shape[1]):
        for j in range(cells.shape[2]):
            n = j % LANES
            if n == 0:
                places(i, j, origin, scale, found)
            cells[0, i, j] = cells[4, i, j] = np.nan
            cells[1, i, j] = cells[2, i, j] = cells[3, i, j] = 0.0
            r = found[RANGE + n]
            # At the viewpoint, too far away, and nearer than the last disparity that is compared nothing is known.
            if r < cell_m or r > reach_m or found[FAR + n] > found[NEAR + n]:
                continue
            ends = directions(found[X + n], found[Y + n], found[AT + n], found[HALF + n], by_angle)
            count = ends[1] - ends[0] + 1
            # Floor and planes: the mean of the disparities. Evidence of the floor is that of something thin, which lies
            # in the cell if it begins before the last directions.
            far, near = int(found[FAR + n]), int(found[NEAR + n])
            run = max(min(round(thin_m / r * by_angle), count), 1)
            weakest, sum_floor, above, below = np.inf, 0.0, 0.0, 0.0
            for u in range(ends[0], ends[1] + 1):
                at_u, total = wrapped(u, width), 0.0
                for k in range(far, near + 1):
                    above += table[at_u, k, ABOVE]
                    below += table[at_u, k, BELOW]
                    sum_floor += table[at_u, k, FLOOR]
                    total += table[at_u, k, FLOOR]
                # One direction in which nothing can be seen makes the cell such, whichever it is.
                if u + run <= ends[1] + 1 and not math.isnan(weakest) and not total >= weakest:
                    weakest = total
            patches = count * (near - far + 1)
            cells[0, i, j], cells[4, i, j] = weakest / (near - far + 1), sum_floor / patches
            cells[1, i, j], cells[2, i, j] = above / patches, below / patches
            # A surface: at the disparities that it has at any of its heights.
            last_surface = int(found[LAST_SURFACE + n])
            first_surface = min(int(found[FIRST_SURFACE + n]), last_surface)
            cells[3, i, j] = mean_surface(table, ends, (first_surface, last_surface))


@compiled("(u1[:, ::1], f8[::1], f8[::1], f8[::1], f8[::1])", writes=("hit", "free"))
def march(state: Bytes, origin: Doubles, azimuths: Doubles, hit: Doubles, free: Doubles) -> None:
    """Write, along directions (N,), the way to the first cell that is taken, inf without one, and that to the end of
    the free floor.

    state (H, W): 0 unknown, 1 free, 2 taken. origin (7,): place in cells, way per step and longest way [m], size of a
    cell [m], share of the range over which a gap in the floor is passed, and the least gap [m] that is.
    """
    height, width = state.shape
    step, longest, cell, gap_share, least_gap = origin[2], origin[3], origin[4], origin[5], origin[6]
    for n in range(len(azimuths)):
        dx, dy = math.cos(azimuths[n]) / cell, math.sin(azimuths[n]) / cell
        hit[n], free[n] = np.inf, 0.0
        ended = False
        r = 0.0
        while r < longest:
            i, j = math.floor(origin[1] + r * dy), math.floor(origin[0] + r * dx)
            if i < 0 or j < 0 or i >= height or j >= width:
                break
            if state[i, j] == 2:
                hit[n] = r
                break
            if state[i, j] == 1 and not ended:
                free[n] = r + step
            elif r - free[n] > max(gap_share * r, least_gap):
                ended = True
            r += step


@compiled("(f8[::1], f8[::1], f8[::1], f8, f8, f8[::1])", writes=("closed",))
def close_openings(
    hit: Doubles, free: Doubles, in_view: Doubles, width: float, least_gap: float, closed: Doubles
) -> None:
    """Write the ways `hit` (N,) along all directions of a turn, where those through narrow openings end at them.

    A way that passes between two surfaces nearer than its own, whose ends are less than `width` [m] apart, ends at the
    farther one of both, unless floor is known up to its own within `least_gap` [m], beyond both, or to where it is in
    view. free, in_view (N,): known floor, and the nearest in view.
    """
    count = len(hit)
    apart = np.empty(count // 2 + 1, np.float64)
    for m in range(len(apart)):
        apart[m] = 2.0 * math.cos(m * math.tau / count)
    for k in range(count):
        closed[k] = hit[k]
        if math.isinf(hit[k]) or hit[k] - free[k] <= least_gap or free[k] >= in_view[k]:
            continue
        most = min(int(width / max(free[k], width) * count / math.tau), count // 4)
        for a in range(1, most + 1):
            left = hit[(k - a) % count]
            for b in range(1, most + 1):
                right = hit[(k + b) % count]
                end = max(left, right)
                if free[k] <= end < closed[k] and left * left + right * right - left * right * apart[a + b] < width**2:
                    closed[k] = end


@compiled(
    "(f4[:, ::1], f4[:, ::1], u1[:, ::1], u1[:, ::1], f8[::1], f8[::1], f8[::1], f8[::1], f4[::1], u1[:, ::1])",
    writes=("found", "near", "behind"),
)
def hidden_from(
    hidden: Floats,
    usual: Floats,
    was_floor: Bytes,
    taken: Bytes,
    origin: Doubles,
    azimuths: Doubles,
    bounds: Doubles,
    found: Doubles,
    near: Floats,
    behind: Bytes,
) -> None:
    """Write, along directions (N,), the range from which on all floor that was free is hidden, NaN where none is; 1 for
    the cells (H, W) from there on; and the log-odds (N,) that what hides it stands nearer than all of it.

    The sum of log-odds from a range to the end of the way is that of all less that of what is nearer: it is largest
    from where the latter is least. Each disparity counts once, however many cells it has. That it stands nearer than
    all of the floor in view has the sum S of all, against the larger one of 0 (nothing is hidden) and of the largest
    sum from farther away: `min(S, least sum up to there)`.
    Floor is hidden where its sum is a share of what it would be without any evidence, m^2 / 4 in each cell: a little
    less evidence than usual in all of a direction is none of that.
    hidden, usual (H, W): log-odds of cells, and usual evidence m; was_floor, taken (H, W): 1 where so. origin (5,):
    viewpoint in cells, size of a cell [m], longest way [m], disparity at 1 m. bounds (4,): least sum, gap [m] in what
    was free that ends a way, as the floor behind an object there may be hidden by it; range [m] to which floor is the
    nearest in view; and the share.
    """
    height, width = hidden.shape
    cell, longest, at_1m = origin[2], origin[3], origin[4]
    step = 0.5 * cell
    for n in range(len(azimuths)):
        dx, dy = math.cos(azimuths[n]) / cell, math.sin(azimuths[n]) / cell
        total, least, begin, last, before = 0.0, 0.0, math.nan, math.nan, math.inf
        full, full_before = 0.0, 0.0  # sum without any evidence, of all and up to the least sum
        r = cell
        while r < longest:
            i, j = math.floor(origin[1] + r * dy), math.floor(origin[0] + r * dx)
            if i < 0 or j < 0 or i >= height or j >= width or taken[i, j] > 0:
                break
            # Nearer than the floor in view nothing is known by floor: what is not free there ends no way.
            if r > bounds[2] and r - last > bounds[1]:
                break
            if was_floor[i, j] > 0:
                weight = at_1m * step / (r * r)
                total += hidden[i, j] * weight
                full += 0.25 * usual[i, j] * usual[i, j] * weight if hidden[i, j] != 0.0 else 0.0
                last = r
                if total <= least:
                    least, begin, full_before = total, math.nan, full
                elif math.isnan(begin):
                    begin = r
                if r >= bounds[2]:
                    before = min(before, total)
            r += step
        found[n] = math.nan
        nearer = min(total, before)
        near[n] = nearer if nearer <= -bounds[0] or total >= max(bounds[0], bounds[3] * full) else 0.0
        if total - least < max(bounds[0], bounds[3] * (full - full_before)):
            continue
        found[n] = r = begin
        while r <= last:
            behind[math.floor(origin[1] + r * dy), math.floor(origin[0] + r * dx)] = 1
            r += step
