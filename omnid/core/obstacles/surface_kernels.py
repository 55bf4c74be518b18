"""Compiled loops of the evidence of surfaces: runs of strips of rows that are at one disparity.

All loops over directions are innermost and without branches, as in column_kernels.py. Sums are those of PART directions
at a time, because those of all directions do not fit into the caches of a core.
"""

from __future__ import annotations

import math

import numpy as np

from omnid.core.compiled import compiled, inner
from omnid.core.obstacles.column_kernels import (
    LARGEST,
    NOTHING,
    ONE,
    Bytes,
    Floats,
    Numbers,
    Words,
    add,
    add_differences,
    difference,
    likelihoods,
    lower_to,
)

PART = 96  # Directions of a part, a divisor of column.DIRECTIONS, so that all parts have as many.
# Sums of likelihoods are never less than this share of one disparity's, so that ratios stay finite.
LEAST_LIKELIHOOD = np.float32(1e-3)
STRIP_FIRST, STRIP_END, STRIP_SURFACE, STRIP_SHIFTS, STRIP_FLOOR, STRIP_BELOW = 0, 1, 2, 3, 4, 5


@inner
def half_sums(
    lower: Bytes, upright: Bytes, live: Bytes, rows: tuple[int, int], part: slice, outlier: np.uint8, sums: Bytes
) -> None:
    """Write the sums (D, PART) of differences over the rows from one to another, for D disparities, in a part."""
    sums[:] = 0
    for v in range(rows[0], rows[1]):
        one, seen = lower[v, part], live[v, part]
        for d in range(len(sums)):
            least, most, into = upright[0, v + d, part], upright[1, v + d, part], sums[d]
            # The compiler knows this count, unlike that of `add_differences`: a third of the time of all.
            for u in range(PART):
                into[u] = np.uint8(into[u] + difference(one[u], least[u], most[u], seen[u], outlier))


@inner
def floor_sums(
    lower: Bytes, plane: Bytes, live: Bytes, rows: tuple[int, int], part: slice, outlier: np.uint8, sums: Words
) -> None:
    """Write the sums (PART,) of differences to the image on the floor's plane, over the rows from one to another."""
    sums[:] = 0
    for v in range(rows[0], rows[1]):
        add_differences(lower[v, part], plane[0, v, part], plane[1, v, part], live[v, part], outlier, sums)


@inner
def add_halves(one: Bytes, other: Bytes, into: Words, best: Words) -> None:
    """Write the sums (W,) of both halves of a strip, and lower `best` to them."""
    for u in range(len(into)):
        total = np.uint16(np.uint16(one[u]) + np.uint16(other[u]))
        into[u] = total
        best[u] = total if total < best[u] else best[u]


@inner
def has_run(before: Floats, mine: Floats, after: Floats, total: Floats, run: Floats) -> bool:
    """True if a run of `add_run` has begun or may begin in some direction: else nothing changes there."""
    found = np.int32(0)
    for u in range(len(run)):
        three = before[u] + mine[u] + after[u]
        others = total[u] - three
        others = others if others > LEAST_LIKELIHOOD else LEAST_LIKELIHOOD
        found |= np.int32(run[u] > NOTHING) | np.int32(three + LEAST_LIKELIHOOD > others)
    return bool(found > 0)


@inner
def add_run(
    before: Floats,
    mine: Floats,
    after: Floats,
    total: Floats,
    blank: np.float32,
    bound: np.float32,
    prior: np.float32,
    run: Floats,
    best: Floats,
) -> None:
    """Go on with the maximum-sum runs (W,) by a strip (Kadane), and raise `best` to them.

    before, mine, after: likelihoods of three neighbouring disparities; total: of all of them. The logarithm is taken as
    2 (x^(1/4) - x^(-1/4)); blank: that of the number of the others by these three. A strip without texture, and one
    that fits at two disparities, is no evidence.
    """
    for u in range(len(run)):
        three = before[u] + mine[u] + after[u]
        others = total[u] - three
        others = others if others > LEAST_LIKELIHOOD else LEAST_LIKELIHOOD
        root = np.float32(math.sqrt(math.sqrt((three + LEAST_LIKELIHOOD) / others)))
        ratio = np.float32(2.0) * (root - ONE / root)
        without = ratio + blank
        ratio = ratio if ratio > NOTHING else (without if without < NOTHING else NOTHING)
        ratio = ratio if ratio < bound else bound
        ratio = ratio if ratio > -bound else -bound
        value = run[u] + ratio - prior
        value = value if value > NOTHING else NOTHING
        run[u] = value
        best[u] = value if value > best[u] else best[u]


@inner
def add_runs(
    value: Floats,
    total: Floats,
    disparities: tuple[int, int],
    weights: np.float32,
    bound: np.float32,
    prior: np.float32,
    run: Floats,
    part: slice,
    surface: Floats,
) -> None:
    """Go on with the runs (K, PART) of a strip's disparities from the first to the end, and raise `surface` to them.

    value (K + 2, PART): likelihoods with a border; weights: sum of those of all explanations; part: of surface (K, W),
    a row of which is contiguous only where it is cut here. Others as for `add_run`.
    """
    fourth = math.pow((weights - 3.0) / 3.0, 0.25)
    blank = np.float32(2.0 * (fourth - 1.0 / fourth))
    for d in range(disparities[0], disparities[1]):
        if has_run(value[d], value[d + 1], value[d + 2], total, run[d]):
            add_run(value[d], value[d + 1], value[d + 2], total, blank, bound, prior, run[d], surface[d, part])


@inner
def keep_peaks(surface: Floats) -> None:
    """Clear ratios (K, W) that are lower than one of the next disparities: a surface fits a little there, too."""
    bins, width = surface.shape
    before = np.zeros(width, np.float32)
    for d in range(bins):
        mine, after = surface[d], surface[min(d + 1, bins - 1)]
        for u in range(width):
            value = mine[u]
            mine[u] = value if (value >= before[u]) & (value >= after[u]) else NOTHING
            before[u] = value


@compiled(
    "(u1[:, ::1], u1[:, :, ::1], u1[:, :, ::1], u1[:, ::1], i4[:, ::1], u1, f4, f4, f4, f4, f4, f4[:, ::1])",
    writes=("surface",),
)
def surface_evidence(
    lower: Bytes,
    upright: Bytes,
    plane: Bytes,
    live: Bytes,
    strips: Numbers,
    outlier: np.uint8,
    scale: np.float32,
    floor_weight: np.float32,
    below_weight: np.float32,
    bound: np.float32,
    prior: np.float32,
    surface: Floats,
) -> None:
    """Write the best run (K, W) of strips of rows that are a surface, where it fits best, as a log-likelihood ratio.

    Images as for floor_evidence. strips (N, 6), from above: first row and end; first disparity that is a surface within
    the robot's heights, and end of the disparities, which never rises; 1 where the floor is an explanation, too; end of
    the disparities that lie below the floor.
    outlier: as for floor_evidence; half of a strip's rows times it is less than 256.
    floor_weight, below_weight: probability of the floor, and of a disparity below it, by that of one above it; bound:
    of the ratio of a strip; prior: less ratio.
    """
    width, bins = lower.shape[1], len(surface)
    halves, floor = np.empty((2, bins, PART), np.uint8), np.empty(PART, np.uint16)
    sums, best = np.empty((bins, PART), np.uint16), np.empty(PART, np.uint16)
    value, total = np.empty((bins + 2, PART), np.float32), np.empty(PART, np.float32)
    run, plain = np.empty((bins, PART), np.float32), np.empty(PART, np.float32)
    surface[:] = NOTHING
    for begin in range(0, width, PART):
        part, kept = slice(begin, begin + PART), -1
        run[:], value[0] = NOTHING, NOTHING
        for n in range(len(strips)):
            first, end = strips[n, STRIP_FIRST], strips[n, STRIP_END]
            mine, last, below = strips[n, STRIP_SURFACE], strips[n, STRIP_SHIFTS], strips[n, STRIP_BELOW]
            if last <= mine:
                continue
            # 1. The differences of both halves: the first one is the second of the strip above.
            middle = (first + end) // 2
            if kept != first:
                half_sums(lower, upright, live, (first, middle), part, outlier, halves[n % 2, :last])
            half_sums(lower, upright, live, (middle, end), part, outlier, halves[(n + 1) % 2, :last])
            kept = middle
            best[:], total[:], value[last + 1] = LARGEST, NOTHING, NOTHING
            for d in range(last):
                add_halves(halves[0, d], halves[1, d], sums[d], best)
            # 2. The likelihoods of the floor and of all disparities.
            if strips[n, STRIP_FLOOR] > 0:
                floor_sums(lower, plane, live, (first, end), part, outlier, floor)
                lower_to(floor, best)
                likelihoods(floor, best, scale, plain)
                add(plain, floor_weight, total)
            for d in range(last):
                likelihoods(sums[d], best, scale, value[d + 1])
                add(value[d + 1], below_weight if d < below else ONE, total)
            # 3. The runs.
            weights = below * below_weight + (last - below)
            weights += floor_weight if strips[n, STRIP_FLOOR] > 0 else NOTHING
            add_runs(value, total, (mine, last), weights, bound, prior, run, part, surface)
    keep_peaks(surface)
