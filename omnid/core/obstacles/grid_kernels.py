"""Compiled loops of the obstacle grid: evidence of directions and ranges, gathered by cells; ways along directions."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from omnid.core.compiled import compiled

Floats = NDArray[np.float32]
Doubles = NDArray[np.float64]
Bytes = NDArray[np.uint8]


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
    compared.
    origin (6,): place of the middle of cell (0, 0) in the frame of the columns, cosine and sine of its axes there, and
    by how much [m] a surface at the viewpoint's height appears nearer than its foot along x and y, as the rig leans;
    at_1m: disparity at 1 m; reach_m: farther cells are left out; thin_m: width of the thinnest
    obstacle, whose directions count together.
    """
    bins, width = floor.shape
    likelihoods = np.empty((bins, width), np.float32)
    for k in range(bins):
        for u in range(width):
            likelihoods[k, u] = math.exp(surface[k, u])
    by_angle = width / math.tau
    c, s = origin[2], origin[3]
    for i in range(cells.shape[1]):
        for j in range(cells.shape[2]):
            x = origin[0] + cell_m * (c * j - s * i)
            y = origin[1] + cell_m * (s * j + c * i)
            r = math.sqrt(x * x + y * y)
            cells[0, i, j], cells[1, i, j], cells[2, i, j], cells[3, i, j], cells[4, i, j] = (
                np.nan,
                0.0,
                0.0,
                0.0,
                np.nan,
            )
            if r < cell_m or r > reach_m:
                continue
            at = (math.pi - math.atan2(y, x)) * by_angle - 0.5
            half = 0.5 * cell_m / r * by_angle
            first, last = math.ceil(at - half), math.floor(at + half)
            if last < first:
                first = last = round(at)
            near = min(math.floor(at_1m / (r - 0.5 * cell_m)), bins - 1)
            far = math.floor(at_1m / (r + 0.5 * cell_m))
            if far > near:  # nearer than the last disparity that is compared
                continue
            # A surface counts in the cell of its foot, whichever of its heights is seen.
            lean = (origin[4] * x + origin[5] * y) / r
            nearest, farthest = r - 0.5 * cell_m - max(lean, 0.0), r + 0.5 * cell_m - min(lean, 0.0)
            last_surface = bins - 1
            if nearest * (bins - 1) > at_1m:
                last_surface = min(math.floor(at_1m / nearest + 0.5), bins - 1)
            first_surface = min(math.floor(at_1m / farthest + 0.5), last_surface)
            least, sum_floor, likelihood, above, below = np.inf, 0.0, 0.0, 0.0, 0.0
            run = max(min(round(thin_m / r * by_angle), last - first + 1), 1)
            for u in range(first, last + 1):
                at_u = (u + width) % width
                for k in range(first_surface, last_surface + 1):
                    likelihood += likelihoods[k, at_u]
                for k in range(far, near + 1):
                    above += level[0, k, at_u]
                    below += level[1, k, at_u]
                    sum_floor += floor[k, at_u]
                if u + run <= last + 1:
                    # The mean of the disparities, the sum of the directions that something thin would hide.
                    total = 0.0
                    for n in range(u, u + run):
                        for k in range(far, near + 1):
                            total += floor[k, (n + width) % width]
                    # One direction in which nothing can be seen makes the cell such, whichever it is.
                    if not math.isnan(least) and not total >= least:
                        least = total
            cells[0, i, j] = least / (near - far + 1)
            patches = (last - first + 1) * (near - far + 1)
            cells[1, i, j], cells[2, i, j] = above / patches, below / patches
            count = (last - first + 1) * (last_surface - first_surface + 1)
            cells[3, i, j] = math.log(likelihood / count)
            cells[4, i, j] = sum_floor * run / patches  # in units of what something thin would hide, as the weakest


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


@compiled(
    "(f4[:, ::1], u1[:, ::1], u1[:, ::1], f8[::1], f8[::1], f8[::1], f8[::1], u1[:, ::1])", writes=("found", "behind")
)
def hidden_from(
    hidden: Floats,
    was_free: Bytes,
    taken: Bytes,
    origin: Doubles,
    azimuths: Doubles,
    bounds: Doubles,
    found: Doubles,
    behind: Bytes,
) -> None:
    """Write, along directions (N,), the range from which on all floor that was free is hidden, NaN where none is; and 1
    for the cells (H, W) from there on.

    The sum of log-odds from a range to the end of the way is that of all less that of what is nearer: it is largest
    from where the latter is least. Each disparity counts once, however many cells it has.
    hidden (H, W): log-odds of cells; was_free, taken (H, W): 1 where so. origin (5,): viewpoint in cells, size of a
    cell [m], longest way [m], disparity at 1 m. bounds (2,): least sum, and gap [m] in what was free that ends a way:
    the floor behind an object there may be hidden by it.
    """
    height, width = hidden.shape
    cell, longest, at_1m = origin[2], origin[3], origin[4]
    step = 0.5 * cell
    for n in range(len(azimuths)):
        dx, dy = math.cos(azimuths[n]) / cell, math.sin(azimuths[n]) / cell
        total, least, begin, last = 0.0, 0.0, math.nan, math.nan
        r = cell
        while r < longest:
            i, j = math.floor(origin[1] + r * dy), math.floor(origin[0] + r * dx)
            if i < 0 or j < 0 or i >= height or j >= width or taken[i, j] > 0 or r - last > bounds[1]:
                break
            if was_free[i, j] > 0:
                total += hidden[i, j] * at_1m * step / (r * r)
                last = r
                if total <= least:
                    least, begin = total, math.nan
                elif math.isnan(begin):
                    begin = r
            r += step
        found[n] = math.nan
        if total - least < bounds[0]:
            continue
        found[n] = r = begin
        while r <= last:
            behind[math.floor(origin[1] + r * dy), math.floor(origin[0] + r * dx)] = 1
            r += step
