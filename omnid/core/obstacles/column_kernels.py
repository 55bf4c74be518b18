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

LARGEST = np.uint16(65535)  # The largest number of 16 bits: exact.
ONE, NOTHING = np.float32(1.0), np.float32(0.0)
# Sums of likelihoods are never less than this share of one disparity's, so that ratios stay finite.
LEAST_LIKELIHOOD = np.float32(1e-3)
# exp(x) is taken as (1 + x / 32)^32, since five products are faster: within 10 % from -2 to 2, and 0 below -32.
EXP_SHARE = np.float32(1 / 32)
FLOOR_FIRST, FLOOR_END, FLOOR_FROM, FLOOR_LOW, FLOOR_HIGH, FLOOR_TO, FLOOR_NEAR = 0, 1, 2, 3, 4, 5, 6
STRIP_FIRST, STRIP_END, STRIP_SURFACE, STRIP_SHIFTS, STRIP_FLOOR = 0, 1, 2, 3, 4


@inner
def add_differences(lower: Bytes, least: Bytes, most: Bytes, live: Bytes, outlier: np.uint8, sums: Words) -> None:
    """Add to sums (W,) by how much a row lies outside of the bounds of another one, at most an outlier's."""
    for u in range(len(sums)):
        a = lower[u]
        above = np.uint8(a - most[u]) if a > most[u] else np.uint8(0)
        below = np.uint8(least[u] - a) if least[u] > a else np.uint8(0)
        difference = above | below
        difference = difference if difference < outlier else outlier
        sums[u] = np.uint16(sums[u] + np.uint16(difference & live[u]))


@inner
def add_between(
    lower: Bytes, first: Bytes, second: Bytes, share: np.uint16, live: Bytes, outlier: np.uint8, sums: Words
) -> None:
    """Add to sums (W,) by how much a row differs from a place between two others; share: of the second one, of 256."""
    rest = np.uint16(np.uint16(256) - share)
    for u in range(len(sums)):
        between = np.uint8(np.uint16(np.uint16(first[u]) * rest + np.uint16(second[u]) * share) >> np.uint16(8))
        a = lower[u]
        difference = np.uint8(a - between) if a > between else np.uint8(between - a)
        difference = difference if difference < outlier else outlier
        sums[u] = np.uint16(sums[u] + np.uint16(difference & live[u]))


@inner
def likelihoods(sums: Words, best: Words, scale: np.float32, into: Floats) -> None:
    """Write exp(-scale (sums - best)) (W,)."""
    for u in range(len(into)):
        x = ONE - scale * EXP_SHARE * (np.float32(sums[u]) - np.float32(best[u]))
        x = x if x > NOTHING else NOTHING
        x = x * x
        x = x * x
        x = x * x
        x = x * x
        into[u] = x * x


@inner
def spread(sums: Words, into: Words) -> None:
    """Write the sums (W,) of each direction twice and of its neighbours."""
    width = len(sums)
    for u in range(1, width - 1):
        into[u] = np.uint16(sums[u - 1] + sums[u] + sums[u] + sums[u + 1])
    into[0] = np.uint16(sums[width - 1] + sums[0] + sums[0] + sums[1])
    into[width - 1] = np.uint16(sums[width - 2] + sums[width - 1] + sums[width - 1] + sums[0])


@inner
def add(values: Floats, weight: np.float32, total: Floats) -> None:
    """Add weight * values (W,) to a total (W,)."""
    for u in range(len(total)):
        total[u] += weight * values[u]


@inner
def lower_to(values: Words, into: Words) -> None:
    """Lower `into` (W,) to values (W,)."""
    for u in range(len(into)):
        into[u] = values[u] if values[u] < into[u] else into[u]


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


@compiled(
    "(u1[:, ::1], u1[:, ::1], f4[::1], u1[:, ::1], i4[:, ::1], f4[:, :, ::1], u1, f4, f4[:, :, ::1])",
    writes=("ratios",),
)
def level_evidence(
    lower: Bytes,
    upper: Bytes,
    plane: Floats,
    live: Bytes,
    bins: Numbers,
    offsets: Floats,
    outlier: np.uint8,
    scale: np.float32,
    ratios: Floats,
) -> None:
    """Write the log-likelihood ratios (2, K, W) of the floor to the best level patch above it, and to one below it.

    lower, upper (H, W): normalised panoramas; plane (H,): row of the upper one that shows the floor of a row. live,
    bins: as for floor_evidence. offsets (3, K, J): differences of disparity of patches of the floor, above and below,
    NaN: no more; scale: logarithm of the likelihood by a unit of difference, by 64.
    """
    width = lower.shape[1]
    sums, wide = np.zeros(width, np.uint16), np.empty(width, np.uint16)
    best = np.empty((3, width), np.uint16)
    ratios[:] = NOTHING
    for k in range(len(bins)):
        if bins[k, FLOOR_END] <= bins[k, FLOOR_FIRST]:
            continue
        best[:] = LARGEST
        for kind in range(3):
            for j in range(offsets.shape[2]):
                if math.isnan(offsets[kind, k, j]):
                    continue
                sums[:] = 0
                for v in range(bins[k, FLOOR_FIRST], bins[k, FLOOR_END]):
                    row = plane[v] + offsets[kind, k, j]
                    above = math.floor(row)
                    share = np.uint16((row - np.float32(above)) * np.float32(256.0))
                    add_between(lower[v], upper[above], upper[above + 1], share, live[v], outlier, sums)
                spread(sums, wide)
                spread(wide, sums)
                spread(sums, wide)
                lower_to(wide, best[kind])
        for kind in range(2):
            for u in range(width):
                ratios[kind, k, u] = scale * (np.float32(best[kind + 1, u]) - np.float32(best[0, u]))


@compiled(
    "(u1[:, ::1], u1[:, :, ::1], u1[:, :, ::1], u1[:, ::1], i4[:, ::1], u1, f4, f4, f4[::1], f4[:, ::1])",
    writes=("others",),
)
def floor_evidence(
    lower: Bytes,
    upright: Bytes,
    plane: Bytes,
    live: Bytes,
    bins: Numbers,
    outlier: np.uint8,
    scale: np.float32,
    near_scale: np.float32,
    prior: Floats,
    others: Floats,
) -> None:
    """Write the mean likelihood (K, W) of all disparities but the floor's, by that of the floor.

    lower (H, W): normalised lower panorama; upright, plane (2, H, W): least and most of the upper one about each pixel,
    and on the plane of the floor. live (H, W): 255 where pixels may be compared, else 0.
    bins (K, 7): first row and end of the rows of the floor at that disparity, 0 and 0 for none; of the disparities the
    first, the last that is lower than the floor, the first that is higher, and the end; 1 where neighbouring directions
    count, too.
    outlier: most that a pixel differs; scale: logarithm of the likelihood by a unit of difference;
    near_scale: where neighbours count. prior: weight of a disparity by its difference from the floor's.
    """
    width, deepest = lower.shape[1], 0
    for k in range(len(bins)):
        deepest = max(deepest, bins[k, FLOOR_TO])
    sums, floor = np.zeros((deepest + 1, width), np.uint16), np.zeros(width, np.uint16)
    value, wide, wide_floor = np.empty(width, np.float32), np.empty(width, np.uint16), np.empty(width, np.uint16)
    others[:] = ONE
    for k in range(len(bins)):
        first, end, low, high = bins[k, FLOOR_FIRST], bins[k, FLOOR_END], bins[k, FLOOR_LOW], bins[k, FLOOR_HIGH]
        if end <= first:
            continue
        begin, last = bins[k, FLOOR_FROM], bins[k, FLOOR_TO]
        sums[:], floor[:] = 0, 0
        for v in range(first, end):
            add_differences(lower[v], plane[0, v], plane[1, v], live[v], outlier, floor)
            for d in range(begin, last):
                if d <= low or d >= high:
                    add_differences(lower[v], upright[0, v + d], upright[1, v + d], live[v], outlier, sums[d])
        others[k] = NOTHING
        weights = NOTHING
        spread(floor, wide_floor)
        for d in range(begin, last):
            if d <= low or d >= high:
                if bins[k, FLOOR_NEAR] > 0:
                    spread(sums[d], wide)
                    likelihoods(wide, wide_floor, near_scale, value)
                else:
                    likelihoods(sums[d], floor, scale, value)
                add(value, prior[abs(d - k)], others[k])
                weights += prior[abs(d - k)]
        for u in range(width):
            others[k, u] /= weights


@compiled(
    "(u1[:, ::1], u1[:, :, ::1], u1[:, :, ::1], u1[:, ::1], i4[:, ::1], u1, f4, f4, f4, f4, f4[:, ::1])",
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
    bound: np.float32,
    prior: np.float32,
    surface: Floats,
) -> None:
    """Write the best run (K, W) of strips of rows that are a surface at a disparity, as a log-likelihood ratio.

    Images as for floor_evidence. strips (N, 5), from above: first row and end; first disparity that is a surface within
    the robot's heights, and end of the disparities; 1 where the floor is an explanation, too.
    floor_weight: probability of the floor by that of one disparity; bound: of the ratio of a strip; prior: less ratio.
    """
    width, bins = lower.shape[1], len(surface)
    sums, floor = np.zeros((bins, width), np.uint16), np.zeros(width, np.uint16)
    value, total = np.zeros((bins + 2, width), np.float32), np.empty(width, np.float32)
    best, plain = np.empty(width, np.uint16), np.empty(width, np.float32)
    run = np.zeros((bins, width), np.float32)
    surface[:] = NOTHING
    for n in range(len(strips)):
        first, end = strips[n, STRIP_FIRST], strips[n, STRIP_END]
        mine, last = strips[n, STRIP_SURFACE], strips[n, STRIP_SHIFTS]
        if last <= mine:
            continue
        sums[:last], floor[:], best[:] = 0, 0, LARGEST
        for v in range(first, end):
            for d in range(last):
                add_differences(lower[v], upright[0, v + d], upright[1, v + d], live[v], outlier, sums[d])
        for d in range(last):
            lower_to(sums[d], best)
        total[:] = NOTHING
        if strips[n, STRIP_FLOOR] > 0:
            for v in range(first, end):
                add_differences(lower[v], plane[0, v], plane[1, v], live[v], outlier, floor)
            lower_to(floor, best)
            likelihoods(floor, best, scale, plain)
            add(plain, floor_weight, total)
        value[last + 1] = NOTHING
        for d in range(last):
            likelihoods(sums[d], best, scale, value[d + 1])
            add(value[d + 1], ONE, total)
        fourth = math.pow((last + strips[n, STRIP_FLOOR] * floor_weight - 3.0) / 3.0, 0.25)
        blank = np.float32(2.0 * (fourth - 1.0 / fourth))
        for d in range(mine, last):
            add_run(value[d], value[d + 1], value[d + 2], total, blank, bound, prior, run[d], surface[d])
