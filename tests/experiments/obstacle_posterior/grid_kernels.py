"""Compiled loops of the obstacle grid: evidence of directions and ranges, gathered by cells; ways along directions."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from omnid.core.compiled import compiled

Floats = NDArray[np.float32]
Doubles = NDArray[np.float64]
Bytes = NDArray[np.uint8]

# Columns of an image on either side whose mean is one direction: the weakest direction of a cell counts.
HALF_DIRECTION = 1


@compiled("(f4[:, ::1], f4[:, ::1], f4[:, ::1], f8[::1], f8[::1], f8, f4[:, :, ::1])", writes=("cells",))
def gather(floor: Floats, surface: Floats, edge: Floats, origin: Doubles, geometry: Doubles, cell_m: float,
           cells: Floats) -> None:
    """Write the evidence (3, N, N) of cells: floor of the weakest direction, surface of the strongest, edge; NaN: not
    in view.

    floor, surface, edge (K, W): log-likelihood ratios of bins of disparity and columns, NaN where nothing is compared.
    origin (4,): place of the middle of cell (0, 0) in the frame of the columns, and cosine and sine of its axes there;
    geometry (3,): focal length px, disparity at 1 m, share of a bin at which its middle lies.
    """
    bins, width = floor.shape
    focal, at_1m, middle = geometry[0], geometry[1], geometry[2]
    c, s = origin[2], origin[3]
    for i in range(cells.shape[1]):
        for j in range(cells.shape[2]):
            x = origin[0] + cell_m * (c * j - s * i)
            y = origin[1] + cell_m * (s * j + c * i)
            r = math.sqrt(x * x + y * y)
            cells[0, i, j], cells[1, i, j], cells[2, i, j] = np.nan, np.nan, np.nan
            if r < cell_m:
                continue
            at = (math.pi - math.atan2(y, x)) * focal - 0.5
            half = 0.5 * cell_m / r * focal
            first, last = math.ceil(at - half), math.floor(at + half)
            if last < first:
                first = last = round(at)
            near = math.floor(at_1m / (r - 0.5 * cell_m) - middle + 0.5)
            far = math.floor(at_1m / (r + 0.5 * cell_m) - middle + 0.5)
            if far >= bins:
                continue
            near = min(near, bins - 1)
            least, most, mean_edge = np.float32(np.inf), np.float32(0.0), np.float32(0.0)
            for u in range(first, last + 1):
                at_u = (u + width) % width
                total, edges = np.float32(0.0), np.float32(0.0)
                for k in range(max(far, 0), near + 1):
                    for n in range(u - HALF_DIRECTION, u + HALF_DIRECTION + 1):
                        total += floor[k, (n + width) % width]
                    edges += edge[k, at_u]
                    if surface[k, at_u] > most:
                        most = surface[k, at_u]
                if not total >= least:
                    least = total
                mean_edge += edges
            least /= np.float32(2 * HALF_DIRECTION + 1)
            # The best of many is less evidence than one.
            count = np.float32((last - first + 1) * (near - max(far, 0) + 1))
            most = max(most - np.log(count), np.float32(0.0))
            cells[0, i, j] = least
            cells[1, i, j] = most
            # No edge is thin.
            cells[2, i, j] = mean_edge / np.float32(last - first + 1)


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
