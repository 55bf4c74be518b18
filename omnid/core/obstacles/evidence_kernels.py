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
# exp(x) is taken as (1 + x / 32)^32, since five products are faster: within 10 % from -2 to 2, and 0 below -32.
EXP_SHARE = np.float32(1 / 32)
# Sums of likelihoods are never less than this share of one disparity's, so that ratios stay finite.
LEAST_LIKELIHOOD = np.float32(1e-3)
# Directions whose sums fit into the caches of a core, a divisor of panoramas.DIRECTIONS.
PART = 96
PATCH_FIRST, PATCH_END, PATCH_FROM, PATCH_LOW, PATCH_HIGH, PATCH_TO, PATCH_THIN = range(7)
STRIP_FIRST, STRIP_END, STRIP_SURFACE, STRIP_SHIFTS, STRIP_FLOOR, STRIP_BELOW = range(6)


@compiled("(f4[:, ::1], i8, f4, f4[:, ::1])", writes=("band",))
def bounded_band_pass(smooth: Floats, rows: int, most: np.float32, band: Floats) -> None:
    """Write by how much the pixels of an image (H, W) exceed those of their column, in the mean of an odd number of
    rows, of which each counts `most` at most: a strong edge hides no weak texture around it."""
    last, half = len(smooth) - 1, rows // 2
    band[:] = NOTHING
    for v in range(len(smooth)):
        mine, into = smooth[v], band[v]
        for at in range(v - half, v + half + 1):
            other = smooth[last - abs(last - abs(at))]  # mirrored at the borders
            for u in range(len(into)):
                above = mine[u] - other[u]
                above = above if above < most else most
                into[u] += above if above > -most else -most
        for u in range(len(into)):
            into[u] /= np.float32(rows)


@inner
def difference(lower: np.uint8, least: np.uint8, most: np.uint8, live: np.uint8, outlier: np.uint8) -> np.uint8:
    """Return by how much a pixel lies outside of the bounds of another one, at most an outlier's; live: 255, else 0."""
    above = np.uint8(lower - most) if lower > most else np.uint8(0)
    below = np.uint8(least - lower) if least > lower else np.uint8(0)
    found = above | below
    return np.uint8((found if found < outlier else outlier) & live)


@inner
def add_differences(lower: Bytes, least: Bytes, most: Bytes, live: Bytes, outlier: np.uint8, sums: Words) -> None:
    """Add to sums (W,) by how much a row lies outside of the bounds of another one, at most an outlier's."""
    for u in range(len(sums)):
        sums[u] = np.uint16(sums[u] + np.uint16(difference(lower[u], least[u], most[u], live[u], outlier)))


@inner
def add_between(
    lower: Bytes, first: Bytes, second: Bytes, share: np.uint16, live: Bytes, outlier: np.uint8, sums: Words
) -> None:
    """Add to sums (W,) by how much a row differs from a place between two others; share: of the second one, of 256."""
    rest = np.uint16(np.uint16(256) - share)
    for u in range(len(sums)):
        between = np.uint8(np.uint16(np.uint16(first[u]) * rest + np.uint16(second[u]) * share) >> np.uint16(8))
        sums[u] = np.uint16(sums[u] + np.uint16(difference(lower[u], between, between, live[u], outlier)))


@inner
def add_likelihoods(
    sums: Words, best: Words, scale: np.float32, weight: np.float32, into: Floats, total: Floats
) -> None:
    """Write exp(-scale (sums - best)) (W,), and add so many times that to a total (W,)."""
    for u in range(len(into)):
        x = ONE - scale * EXP_SHARE * (np.float32(sums[u]) - np.float32(best[u]))
        x = x if x > NOTHING else NOTHING
        x = x * x
        x = x * x
        x = x * x
        x = x * x
        into[u] = x * x
        total[u] += weight * into[u]


@inner
def spread(sums: Words, into: Words) -> None:
    """Write the sums (W,) of each direction twice and of its neighbours."""
    width = len(sums)
    for u in range(1, width - 1):
        into[u] = np.uint16(sums[u - 1] + sums[u] + sums[u] + sums[u + 1])
    into[0] = np.uint16(sums[width - 1] + sums[0] + sums[0] + sums[1])
    into[width - 1] = np.uint16(sums[width - 2] + sums[width - 1] + sums[width - 1] + sums[0])


@inner
def add_next(sums: Words, count: int, into: Words) -> None:
    """Write the sums (W,) of each direction and of those that follow it, so many together."""
    width = len(sums)
    into[:] = sums
    for m in range(1, count):
        for u in range(width - m):
            into[u] = np.uint16(into[u] + sums[u + m])
        for u in range(width - m, width):
            into[u] = np.uint16(into[u] + sums[u + m - width])


@inner
def lower_to(values: Words, into: Words) -> None:
    """Lower `into` (W,) to values (W,)."""
    for u in range(len(into)):
        into[u] = values[u] if values[u] < into[u] else into[u]


@compiled(
    "(u1[:, ::1], u1[:, ::1], u1[:, :, ::1], u1[:, :, ::1], u1[:, ::1], f4[::1], i4[:, ::1], f4[:, :, ::1], f4[::1],"
    " u1, f4, f4, f4, f4[:, ::1], f4[:, :, ::1])",
    writes=("others", "level"),
)
def floor_evidence(
    lower: Bytes,
    upper: Bytes,
    upright: Bytes,
    plane: Bytes,
    live: Bytes,
    plane_rows: Floats,
    patches: Numbers,
    offsets: Floats,
    prior: Floats,
    outlier: np.uint8,
    scale: np.float32,
    level_scale: np.float32,
    fit_of_noise: np.float32,
    others: Floats,
    level: Floats,
) -> None:
    """Write the mean likelihood (K, W) of all disparities but the floor's, by that of the floor, and the log-likelihood
    ratios (2, K, W) of the floor to the best level patch above it, and to one below it.

    Where one of many deeper patches fits as well as the floor there is no evidence for it: a floor that repeats itself,
    and falls deep at an edge, fits at some range by another period. Against it counts what is beyond the fit of noise.

    lower, upper (H, W): normalised panoramas; upright, plane (2, H, W): least and most of the upper one about each
    pixel, and on the plane of the floor. live (H, W): 255 where pixels may be compared, else 0. plane_rows (H,): row of
    the upper one that shows the floor of a row.
    patches (K, 7): first row and end of the rows of the floor at that disparity, 0 and 0 for none; of the disparities
    the first, the last that is lower than the floor, the first that is higher, and the end; the directions that
    something thin hides: their mean is compared, of a direction and those that follow it.
    offsets (4, K, J): differences of disparity of planes that are the floor, above, just below and deeper, NaN: none;
    what is low is wide, and seven directions are compared. prior: weight of a disparity by its difference from the
    floor's. outlier: most that a pixel differs; scale, level_scale: logarithm of the likelihood by a unit of
    difference; fit_of_noise: log-likelihood by which the best of the deeper patches may fit better by noise.
    """
    width = lower.shape[1]
    sums, floor, next_sums = np.empty(width, np.uint16), np.empty(width, np.uint16), np.empty(width, np.uint16)
    best, value = np.empty((4, width), np.uint16), np.empty(width, np.float32)
    others[:], level[:] = ONE, NOTHING
    for k in range(len(patches)):
        first, end = patches[k, PATCH_FIRST], patches[k, PATCH_END]
        if end <= first:
            continue
        # 1. Upright things at other disparities, of single thin ones.
        together = patches[k, PATCH_THIN]
        others[k], weights = NOTHING, NOTHING
        sums[:] = 0
        for v in range(first, end):
            add_differences(lower[v], plane[0, v], plane[1, v], live[v], outlier, sums)
        add_next(sums, together, floor)
        for d in range(patches[k, PATCH_FROM], patches[k, PATCH_TO]):
            if d <= patches[k, PATCH_LOW] or d >= patches[k, PATCH_HIGH]:
                sums[:] = 0
                for v in range(first, end):
                    add_differences(lower[v], upright[0, v + d], upright[1, v + d], live[v], outlier, sums)
                add_next(sums, together, next_sums)
                add_likelihoods(next_sums, floor, scale / np.float32(together), prior[abs(d - k)], value, others[k])
                weights += prior[abs(d - k)]
        others[k] /= weights
        # 2. Planes.
        best[:] = LARGEST
        for kind in range(4):
            for offset in offsets[kind, k]:
                if math.isnan(offset):
                    continue
                sums[:] = 0
                for v in range(first, end):
                    row = plane_rows[v] + offset
                    above = math.floor(row)
                    share = np.uint16((row - np.float32(above)) * np.float32(256.0))
                    add_between(lower[v], upper[above], upper[above + 1], share, live[v], outlier, sums)
                spread(sums, next_sums)
                spread(next_sums, sums)
                spread(sums, next_sums)
                lower_to(next_sums, best[kind])
        for u in range(width):
            floor_sum = np.float32(best[0, u])
            level[0, k, u] = level_scale * (np.float32(best[1, u]) - floor_sum)
            below = level_scale * (np.float32(best[2, u]) - floor_sum)
            deep = level_scale * (np.float32(best[3, u]) - floor_sum)
            deep = deep if deep > NOTHING else min(deep + fit_of_noise, NOTHING)
            level[1, k, u] = min(below, deep)


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
    """Write the best run (K, W) of strips of rows that are a surface, as a log-likelihood ratio.

    Images as for floor_evidence. strips (N, 6), from above: first row and end, of which the second half is the first
    half of the next strip; first disparity that is a surface within the robot's heights, and end of the disparities,
    which never rises; 1 where the floor is an explanation, too; end of the disparities that lie below the floor.
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
        part = slice(begin, begin + PART)
        run[:], value[0] = NOTHING, NOTHING
        for n in range(len(strips)):
            first, end = strips[n, STRIP_FIRST], strips[n, STRIP_END]
            mine, last, below = strips[n, STRIP_SURFACE], strips[n, STRIP_SHIFTS], strips[n, STRIP_BELOW]
            # 1. The differences of both halves.
            middle = (first + end) // 2
            if n == 0:
                half_sums(lower, upright, live, (first, middle), part, outlier, halves[0, :last])
            half_sums(lower, upright, live, (middle, end), part, outlier, halves[(n + 1) % 2, :last])
            best[:], total[:], value[last + 1] = LARGEST, NOTHING, NOTHING
            for d in range(last):
                for u in range(PART):
                    sums[d, u] = np.uint16(np.uint16(halves[0, d, u]) + np.uint16(halves[1, d, u]))
                lower_to(sums[d], best)
            # 2. The likelihoods of the floor and of all disparities.
            weights = below * below_weight + (last - below)
            if strips[n, STRIP_FLOOR] > 0:
                floor[:] = 0
                for v in range(first, end):
                    seen = live[v, part]
                    add_differences(lower[v, part], plane[0, v, part], plane[1, v, part], seen, outlier, floor)
                lower_to(floor, best)
                add_likelihoods(floor, best, scale, floor_weight, plain, total)
                weights += floor_weight
            for d in range(last):
                add_likelihoods(sums[d], best, scale, below_weight if d < below else ONE, value[d + 1], total)
            # 3. The runs.
            fourth = math.pow((weights - 3.0) / 3.0, 0.25)
            blank = np.float32(2.0 * (fourth - 1.0 / fourth))
            for d in range(mine, last):
                if has_run(value[d], value[d + 1], value[d + 2], total, run[d]):
                    fits = value[d], value[d + 1], value[d + 2]
                    add_run(*fits, total, blank, bound, prior, run[d], surface[d, part])
