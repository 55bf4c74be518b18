"""Compiled loops of the evidence along columns: sums of differences for each disparity, and their likelihoods.

All loops over directions are innermost and without branches: the compiler turns them into vector instructions.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from omnid.core.compiled import compiled, inner

Bytes = NDArray[np.uint8]
Words = NDArray[np.uint16]
Floats = NDArray[np.float32]
Numbers = NDArray[np.int32]

LARGEST = np.uint16(65535)
ONE, NOTHING = np.float32(1.0), np.float32(0.0)
# exp(x) is taken as (1 + x / 32)^32, since five products are faster: within 10 % from -2 to 2, and 0 below -32.
EXP_SHARE = np.float32(1 / 32)
# Directions whose sums fit into the caches of a core, a divisor of panoramas.DIRECTIONS.
PART = 96
UNITS = 12.0  # levels of a normalised image in one sigma: 8 bits hold ten sigmas either way
OUTLIER = np.uint8(4 * UNITS)  # more than four sigmas of difference are no noise
SCALE = np.float32(0.5 / UNITS)  # log-likelihood by a unit of difference, 0.5 a sigma: neighbours are not independent
LEVEL_SCALE = (
    np.float32(2.0 / 3) * SCALE
)  # the same of planes, by the sums of `spread`, of 8 / 3 independent directions
DEEP_NOISE = np.float32(10.0)  # by which the best of the deeper planes may fit better than the floor by noise
STRIP_BOUND = np.float32(3.0)  # limit of the log-likelihood ratio of a strip
STRIP_PRIOR = np.float32(0.5)  # log-odds by which a strip of a surface must exceed its other explanations
LEAST_LIKELIHOOD = np.float32(1e-3)  # of all disparities together, by one: ratios stay finite
# Probability of the floor in rows that may show it, by that of one disparity; and of a disparity below the floor, where
# only holes are, and what a polished floor mirrors. By trial: of walls of bricks, which may be farther ones below the
# floor, 94 % were found with 0.1 and 0.03, 92 % with 0.3, 66 % with 1.
FLOOR_WEIGHT, BELOW_WEIGHT = np.float32(10.0), np.float32(0.1)
FLOOR, ABOVE, BELOW, DEEP = range(4)  # kinds of planes
STRIP_FIRST, STRIP_END, STRIP_SURFACE, STRIP_SHIFTS, STRIP_FLOOR, STRIP_BELOW = range(6)


@inner
def difference(lower: np.uint8, least: np.uint8, most: np.uint8, live: np.uint8) -> np.uint8:
    """Return by how much a pixel lies outside of the bounds of another one, at most an outlier's; live: 255, else 0."""
    above = np.uint8(lower - most) if lower > most else np.uint8(0)
    below = np.uint8(least - lower) if least > lower else np.uint8(0)
    found = above | below
    return np.uint8((found if found < OUTLIER else OUTLIER) & live)


@inner
def spread(sums: Words, into: Words) -> None:
    """Write the sums (W,) of each direction twice and of its neighbours."""
    width = len(sums)
    for u in range(1, width - 1):
        into[u] = np.uint16(sums[u - 1] + sums[u] + sums[u] + sums[u + 1])
    into[0] = np.uint16(sums[width - 1] + sums[0] + sums[0] + sums[1])
    into[width - 1] = np.uint16(sums[width - 2] + sums[width - 1] + sums[width - 1] + sums[0])


@inner
def lower_to(values: Words, into: Words) -> None:
    """Lower `into` (W,) to values (W,)."""
    for u in range(len(into)):
        into[u] = values[u] if values[u] < into[u] else into[u]


@compiled(
    "(u1[:, ::1], u1[:, ::1], u1[:, ::1], f4[::1], i4[:, ::1], f4[:, :, ::1], f4[:, :, ::1])",
    writes=("level",),
)
def level_evidence(
    lower: Bytes,
    upper: Bytes,
    live: Bytes,
    plane_rows: Floats,
    patches: Numbers,
    offsets: Floats,
    level: Floats,
) -> None:
    """Write the log-likelihood ratios (2, K, W) of the floor to the best plane above it, and to the best one below it.

    Where one of many deeper planes fits as well as the floor there is no evidence for it: a floor that repeats itself,
    and falls deep at an edge, fits at some range by another period. Against it counts what is beyond the fit of noise.

    lower, upper (H, W): normalised panoramas; live (H, W): 255 where pixels may be compared, else 0. plane_rows (H,):
    row of the upper one that shows the floor of a row. patches (K, 2): first row and end of the rows of the floor at
    that disparity, 0 and 0 for none. offsets (4, K, J): differences of disparity of planes that are the floor, above,
    just below and deeper, NaN: none. Three directions are compared together.
    """
    width = lower.shape[1]
    sums, spread_sums, best = np.empty(width, np.uint16), np.empty(width, np.uint16), np.empty((4, width), np.uint16)
    level[:] = NOTHING
    for k in range(len(patches)):
        if patches[k, 1] <= patches[k, 0]:
            continue
        best[:] = LARGEST
        for kind in range(4):
            for offset in offsets[kind, k]:
                if math.isnan(offset):
                    continue
                sums[:] = 0
                for v in range(patches[k, 0], patches[k, 1]):
                    row = plane_rows[v] + offset
                    above = math.floor(row)
                    share = np.uint16((row - np.float32(above)) * np.float32(256.0))
                    rest = np.uint16(np.uint16(256) - share)
                    mine, seen, first, second = lower[v], live[v], upper[above], upper[above + 1]
                    for u in range(width):
                        mixed = np.uint16(np.uint16(first[u]) * rest + np.uint16(second[u]) * share) >> np.uint16(8)
                        between = np.uint8(mixed)
                        sums[u] = np.uint16(sums[u] + np.uint16(difference(mine[u], between, between, seen[u])))
                spread(sums, spread_sums)
                lower_to(spread_sums, best[kind])
        for u in range(width):
            floor = np.float32(best[FLOOR, u])
            level[0, k, u] = LEVEL_SCALE * (np.float32(best[ABOVE, u]) - floor)
            below = LEVEL_SCALE * (np.float32(best[BELOW, u]) - floor)
            deep = LEVEL_SCALE * (np.float32(best[DEEP, u]) - floor)
            deep = deep if deep > NOTHING else min(deep + DEEP_NOISE, NOTHING)
            level[1, k, u] = min(below, deep)


@inner
def add_strip(
    lower: Bytes, bounds: Bytes, live: Bytes, rows: tuple[int, int], shift: int, part: slice, sums: Words
) -> None:
    """Write the sums (PART,) of differences over rows to the bounds (2, H, W) of another image, whose rows are shifted.

    Whole arrays are passed: the compiler knows that their rows are contiguous.
    """
    sums[:] = 0
    for v in range(rows[0], rows[1]):
        one, least, most, seen = lower[v, part], bounds[0, v + shift, part], bounds[1, v + shift, part], live[v, part]
        for u in range(PART):  # the compiler knows this count
            sums[u] = np.uint16(sums[u] + np.uint16(difference(one[u], least[u], most[u], seen[u])))


@inner
def add_likelihoods(sums: Words, best: Words, weight: np.float32, into: Floats, total: Floats) -> None:
    """Write the likelihoods (PART,) by sums of differences, and add so many times these to a total (PART,)."""
    for u in range(PART):
        x = ONE - SCALE * EXP_SHARE * (np.float32(sums[u]) - np.float32(best[u]))
        x = x if x > NOTHING else NOTHING
        x = x * x
        x = x * x
        x = x * x
        x = x * x
        into[u] = x * x
        total[u] += weight * into[u]


@inner
def add_run(three: tuple[Floats, Floats, Floats], total: Floats, blank: np.float32, run: Floats, best: Floats) -> None:
    """Go on with the maximum-sum runs (PART,) by a strip (Kadane), and raise `best` to them.

    three: likelihoods of neighbouring disparities; total: of all of them. The logarithm of their ratio is taken as
    2 (x^(1/4) - x^(-1/4)); blank: that of the number of the others by these three. A strip without texture, and one
    that fits at two disparities, is no evidence.
    """
    for u in range(PART):
        mine = three[0][u] + three[1][u] + three[2][u]
        others = total[u] - mine
        others = others if others > LEAST_LIKELIHOOD else LEAST_LIKELIHOOD
        root = np.float32(math.sqrt(math.sqrt((mine + LEAST_LIKELIHOOD) / others)))
        ratio = np.float32(2.0) * (root - ONE / root)
        without = ratio + blank
        ratio = ratio if ratio > NOTHING else (without if without < NOTHING else NOTHING)
        ratio = ratio if ratio < STRIP_BOUND else STRIP_BOUND
        ratio = ratio if ratio > -STRIP_BOUND else -STRIP_BOUND
        value = run[u] + ratio - STRIP_PRIOR
        value = value if value > NOTHING else NOTHING
        run[u] = value
        best[u] = value if value > best[u] else best[u]


@compiled(
    "(u1[:, ::1], u1[:, :, ::1], u1[:, :, ::1], u1[:, ::1], i4[:, ::1], f4[:, ::1])",
    writes=("surface",),
)
def surface_evidence(
    lower: Bytes,
    upright: Bytes,
    plane: Bytes,
    live: Bytes,
    strips: Numbers,
    surface: Floats,
) -> None:
    """Write the best run (K, W) of strips of rows that are a surface, as a log-likelihood ratio.

    lower (H, W), live: as for level_evidence; upright, plane (2, H, W): least and most of the upper panorama about each
    pixel, and on the plane of the floor. strips (N, 6), from above: first row and end; first disparity that is a
    surface within the robot's heights, and end of the disparities; 1 where the floor is an explanation, too; end of the
    disparities that lie below the floor.
    """
    width, bins = lower.shape[1], len(surface)
    sums, best = np.empty((bins + 1, PART), np.uint16), np.empty(PART, np.uint16)
    value, total = np.empty((bins + 2, PART), np.float32), np.empty(PART, np.float32)
    run, plain = np.empty((bins, PART), np.float32), np.empty(PART, np.float32)
    surface[:] = NOTHING
    for begin in range(0, width, PART):
        part = slice(begin, begin + PART)
        run[:], value[0] = NOTHING, NOTHING
        for n in range(len(strips)):
            rows = strips[n, STRIP_FIRST], strips[n, STRIP_END]
            mine, last, below = strips[n, STRIP_SURFACE], strips[n, STRIP_SHIFTS], strips[n, STRIP_BELOW]
            # 1. The differences at all disparities, and on the floor.
            best[:], total[:], value[last + 1] = LARGEST, NOTHING, NOTHING
            for d in range(last):
                add_strip(lower, upright, live, rows, d, part, sums[d])
                lower_to(sums[d], best)
            has_floor = strips[n, STRIP_FLOOR] > 0
            if has_floor:
                add_strip(lower, plane, live, rows, 0, part, sums[bins])
                lower_to(sums[bins], best)
            # 2. The likelihoods.
            weights = below * BELOW_WEIGHT + (last - below)
            if has_floor:
                add_likelihoods(sums[bins], best, FLOOR_WEIGHT, plain, total)
                weights += FLOOR_WEIGHT
            for d in range(last):
                add_likelihoods(sums[d], best, BELOW_WEIGHT if d < below else ONE, value[d + 1], total)
            # 3. The runs.
            fourth = math.pow((weights - 3.0) / 3.0, 0.25)
            blank = np.float32(2.0 * (fourth - 1.0 / fourth))
            for d in range(mine, last):
                fits = value[d], value[d + 1], value[d + 2]
                add_run(fits, total, blank, run[d], surface[d, part])
