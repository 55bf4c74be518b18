"""Compiled loops of the evidence along columns: window costs of all disparities, and their sums over rows.

All loops over columns are innermost and without branches: the compiler turns them into vector instructions.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from omnid.core.compiled import compiled, inner

Bytes = NDArray[np.uint8]
Words = NDArray[np.uint16]
Levels = NDArray[np.int16]
Numbers = NDArray[np.int32]

# Rows of a window on either side of its middle.
HALF_ROWS = 3
# Sums of differences over a window are kept in an eighth or a sixteenth of their units, so that they fit into a byte.
COST_SHIFT, WIDE_SHIFT = np.uint16(3), np.uint16(4)
# Columns that are repeated on either side.
PAD = 4
MOST = np.uint16(255)
MOST_TOTAL = np.uint16(32000)
# Alternatives nearer than this many bins are the same surface.
SAME_BINS = 1


@inner
def add_row(lower: Bytes, upper: Bytes, outlier: np.uint8, sums: Words) -> None:
    """Add the absolute differences of two rows (W + 2 PAD,) to sums, each at most that of an outlier."""
    for u in range(len(sums)):
        a, b = lower[u], upper[u]
        difference = np.uint8(a - b) if a > b else np.uint8(b - a)
        difference = difference if difference < outlier else outlier
        sums[u] = np.uint16(sums[u] + np.uint16(difference))


@inner
def remove_row(lower: Bytes, upper: Bytes, outlier: np.uint8, sums: Words) -> None:
    """Take away what add_row has added."""
    for u in range(len(sums)):
        a, b = lower[u], upper[u]
        difference = np.uint8(a - b) if a > b else np.uint8(b - a)
        difference = difference if difference < outlier else outlier
        sums[u] = np.uint16(sums[u] - np.uint16(difference))


@inner
def lower_to_windows(sums: Words, is_wide: bool, into: Bytes) -> None:
    """Lower `into` (W,) to the costs of windows of 5 or 9 columns about each one, from sums (W + 2 PAD,)."""
    if is_wide:
        for u in range(len(into)):
            total = np.uint16(sums[u] + sums[u + 1] + sums[u + 2] + sums[u + 3] + sums[u + 4] + sums[u + 5]
                              + sums[u + 6] + sums[u + 7] + sums[u + 8]) >> WIDE_SHIFT
            cost = np.uint8(total if total < MOST else MOST)
            into[u] = cost if cost < into[u] else into[u]
    else:
        for u in range(len(into)):
            total = np.uint16(sums[u + 2] + sums[u + 3] + sums[u + 4] + sums[u + 5] + sums[u + 6]) >> COST_SHIFT
            cost = np.uint8(total if total < MOST else MOST)
            into[u] = cost if cost < into[u] else into[u]


@inner
def lower_to(values: Bytes, into: Bytes) -> None:
    """Lower `into` (W,) to values (W,)."""
    for u in range(len(into)):
        into[u] = values[u] if values[u] < into[u] else into[u]


@inner
def lower_to_sums(values: Words, into: Words) -> None:
    """Lower `into` (W,) to values (W,)."""
    for u in range(len(into)):
        into[u] = values[u] if values[u] < into[u] else into[u]


@inner
def add_costs(values: Bytes, sums: Words) -> None:
    """Add values (W,) to sums (W,)."""
    for u in range(len(sums)):
        sums[u] = np.uint16(sums[u] + np.uint16(values[u]))


@inner
def put_share(mine: Words, one: Words, two: Words, share: Levels) -> None:
    """Set the shares (W,) to what the best of two others costs more than mine."""
    for u in range(len(share)):
        other = one[u] if one[u] < two[u] else two[u]
        share[u] = np.int16(np.int16(other) - np.int16(mine[u]))


@inner
def add_run(mine: Bytes, one: Bytes, two: Bytes, bound: np.int16, prior: np.int16, run: Levels, best: Levels) -> None:
    """Go on with the maximum-sum runs (W,) by a row (Kadane), and raise `best` to them."""
    for u in range(len(run)):
        other = one[u] if one[u] < two[u] else two[u]
        share = np.int16(np.int16(other) - np.int16(mine[u]))
        share = share if share < bound else bound
        share = share if share > -bound else np.int16(-bound)
        total = np.int16(np.int16(run[u] + share) - prior)
        total = total if total > 0 else np.int16(0)
        run[u] = total
        best[u] = total if total > best[u] else best[u]


@compiled("(u1[:, ::1], u1[:, :, ::1], u1[:, :, ::1], u1[:, ::1], i4[:, ::1], i4[:, ::1], u1, u1, i2, i2, "
          "i2[:, ::1], i2[:, ::1], i2[:, ::1])", writes=("surface", "level", "below"))
def sweep(lower: Bytes, upper: Bytes, planes: Bytes, live: Bytes, rows: Numbers, shifts: Numbers, outlier: np.uint8,
          unmatched: np.uint8, bound: np.int16, prior: np.int16, surface: Levels, level: Levels, below: Levels) -> None:
    """Write the evidence (K, W) of each direction and bin of disparity: surface, floor, lower than the floor.

    Evidence is the cost of the best other explanation less that of this one, summed over rows.
    lower (H, W + 2 PAD), upper (2, H, W + 2 PAD): normalised panoramas, the upper one also half a row lower; planes:
    the upper one after the warp that brings the floor to the rows of the lower one. live (H, W): 255 where pixels may
    be compared, else 0.
    rows (H, 8): first bin that is a surface within the robot's heights, end of the bins that can be compared; bin of
    the floor (-1: none), last bin lower than the floor, first bin higher than it, the same of the shifts of the planes;
    1 where windows are wide.
    shifts (H, N): bin of the plane that is shifted by n - N // 2 half rows, -1: none.
    outlier: most that a pixel differs; unmatched: cost of a window that nothing explains; bound: of the share of a row;
    prior: of a row that shows no surface.
    """
    height, padded = lower.shape
    width, bins, count = padded - 2 * PAD, len(surface), shifts.shape[1]
    middle = count // 2
    sums, plane_sums = np.zeros((2, bins, padded), np.uint16), np.zeros((count, padded), np.uint16)
    values, after = np.empty((bins, width), np.uint8), np.empty((bins + 1, width), np.uint8)
    tilted = np.empty((count, width), np.uint8)
    upright_total, tilted_total = np.zeros((bins, width), np.uint16), np.zeros((count, width), np.uint16)
    run = np.zeros((bins, width), np.int16)
    floor, other, cap = np.empty(width, np.uint8), np.empty(width, np.uint8), np.empty(width, np.uint8)
    plane, low, high = np.empty(width, np.uint16), np.empty(width, np.uint16), np.empty(width, np.uint16)
    surface[:], level[:], below[:] = 0, 0, 0
    for v in range(-HALF_ROWS, height - HALF_ROWS):
        # 1. Windows move down by a row.
        new, old = v + HALF_ROWS, v - HALF_ROWS - 1
        for k in range(min(bins, height - new)):
            for half in range(2):
                add_row(lower[new], upper[half, new + k], outlier, sums[half, k])
                if old >= 0:
                    remove_row(lower[old], upper[half, old + k], outlier, sums[half, k])
        first_surface, end, floor_bin = rows[max(v, 0), 0], rows[max(v, 0), 1], rows[max(v, 0), 2]
        if rows[max(new, 0), 2] >= 0 or rows[max(old, 0), 2] >= 0:
            for n in range(count):
                at, was = 2 * new + n - middle, 2 * old + n - middle
                if 0 <= at < 2 * height:
                    add_row(lower[new], planes[at % 2, at // 2], outlier, plane_sums[n])
                if old >= 0 and rows[old, 2] >= 0 and 0 <= was < 2 * height:
                    remove_row(lower[old], planes[was % 2, was // 2], outlier, plane_sums[n])
        if v < HALF_ROWS or end <= 0:
            continue
        # 2. Cost of each disparity, for upright surfaces and for planes parallel to the floor. A window that is not
        # live costs nothing at all of them, and so is no evidence.
        shown, is_wide = live[v], rows[v, 7] > 0
        for u in range(width):
            cap[u] = unmatched & shown[u]
        floor[:] = cap
        for k in range(end):
            values[k] = cap
            lower_to_windows(sums[0, k], is_wide, values[k])
            lower_to_windows(sums[1, k], is_wide, values[k])
        if floor_bin >= 0:
            for k in range(end):
                add_costs(values[k], upright_total[k])
            for n in range(count):
                tilted[n] = cap
                k, half = shifts[v, n], 2 * v + n - middle
                if 0 <= k < end and half < 2 * (height - HALF_ROWS):
                    lower_to_windows(plane_sums[n], is_wide, tilted[n])
                    lower_to(tilted[n], floor if abs(n - middle) <= 1 else values[k])
                add_costs(tilted[n], tilted_total[n])
            if rows[v + 1, 2] != floor_bin:
                # 3. The floor against the best that is lower, and the best that is higher, for all rows of a bin.
                plane[:] = tilted_total[middle]
                lower_to_sums(tilted_total[middle - 1], plane)
                lower_to_sums(tilted_total[middle + 1], plane)
                low[:], high[:] = MOST_TOTAL, MOST_TOTAL
                for k in range(min(rows[v, 3] + 1, end)):
                    lower_to_sums(upright_total[k], low)
                for k in range(rows[v, 4], end):
                    lower_to_sums(upright_total[k], high)
                for n in range(rows[v, 5] + 1):
                    lower_to_sums(tilted_total[n], low)
                for n in range(rows[v, 6], count):
                    lower_to_sums(tilted_total[n], high)
                put_share(plane, low, high, level[floor_bin])
                put_share(low, plane, high, below[floor_bin])
                upright_total[:], tilted_total[:] = 0, 0
        # 4. Maximum-sum runs of rows against the best other explanation.
        after[end] = cap
        for k in range(end - 1, first_surface, -1):
            after[k] = after[k + 1]
            lower_to(values[k], after[k])
        other[:] = floor
        for k in range(end):
            if k > SAME_BINS:
                lower_to(values[k - SAME_BINS - 1], other)
            if k >= first_surface:
                add_run(values[k], other, after[min(k + SAME_BINS + 1, end)], bound, prior, run[k], surface[k])
