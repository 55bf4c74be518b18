"""Compiled loops of the evidence along columns: sums of differences for each disparity, their likelihoods, and ramps.

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
Doubles = NDArray[np.float64]
Numbers = NDArray[np.int32]

LARGEST = np.uint16(np.iinfo(np.uint16).max)
ONE, NOTHING = np.float32(1.0), np.float32(0.0)
UNITS = 12.0  # levels of a normalised image in one sigma, because 8 bits hold ten sigmas either way
HIGHEST = np.float32(np.iinfo(np.uint8).max)
OUTLIER = np.uint8(4 * UNITS)  # Most units by which a pixel differs, because more than four sigmas are no noise.
# Log-likelihood by a unit of difference of a direction: 1 by a sigma would be that of independent pixels; and of planes
# beside the floor, which are compared in seven directions together, with weights of 64 in all.
DIFFERENCE_SCALE, LEVEL_SCALE = np.float32(0.5 / UNITS), np.float32(1.5 / (64 * UNITS))
# Log-likelihood by which the best of the deeper planes may fit better than the floor by noise, 1.5 in the mean of a
# plain floor. With 3, by trial, bases did not move on boards of 10 cm that look nearly the same.
DEEP_NOISE = np.float32(10.0)
STRIP_BOUND = np.float32(3.0)  # limit of the log-likelihood ratio of a strip
STRIP_PRIOR = np.float32(0.5)  # log-odds by which a strip of a surface must exceed its other explanations
# Probability of the floor in rows that may show it, by that of one disparity; and of a disparity below the floor, where
# only holes are, and what a polished floor mirrors. By trial: of walls of bricks, which may be farther ones below the
# floor, 94 % were found with 0.1 and 0.03, 92 % with 0.3, 66 % with 1.
FLOOR_WEIGHT, BELOW_WEIGHT = np.float32(10.0), np.float32(0.1)
# Rows by which a strip of the floor may be displaced: a pixel of an image is up to 1.8 of them wide, and a thin joint
# may be seen half a pixel aside in each view. So it is no surface.
MOVED_ROWS = 1
# An object often hides the floor near itself: decay of the prior with the disparity, and the share of it that is left
# far away. Measured: two thirds to 1.5 times as much change nothing.
ADJACENT_PX, DISTANT_SHARE = 4.0, np.float32(0.1)
# exp(x) is computed as (1 + x / 32)^32, since five products are faster: within 10 % from -2 to 2, and 0 below -32.
EXP_SHARE = np.float32(1 / 32)
# Sums of likelihoods are never less than this share of one disparity's, so that ratios stay finite.
LEAST_LIKELIHOOD = np.float32(1e-3)
PATCH_FIRST, PATCH_END, PATCH_FROM, PATCH_LOW, PATCH_HIGH, PATCH_TO, PATCH_THIN = range(7)
STRIP_FIRST, STRIP_END, STRIP_SURFACE, STRIP_SHIFTS, STRIP_FLOOR, STRIP_BELOW = range(6)


@compiled("(f4[:, ::1], i8, i8, f4, f4[:, ::1])", writes=("band",))
def bounded_band_pass(smooth: Floats, first: int, rows: int, most: np.float32, band: Floats) -> None:
    """Write by how much the pixels of an image (H, W) exceed those of their column, from a first row on, in the mean of
    an odd number of rows, of which each counts `most` at most: a strong edge hides no weak texture around it."""
    last, half = len(smooth) - 1, rows // 2
    band[:] = NOTHING
    for v in range(first, len(smooth)):
        mine, into = smooth[v], band[v - first]
        for at in range(v - half, v + half + 1):
            other = smooth[last - abs(last - abs(at))]  # mirrored at the borders
            for u in range(len(into)):
                into[u] += max(min(mine[u] - other[u], most), -most)
        for u in range(len(into)):
            into[u] /= np.float32(rows)


@compiled("(f4[:, ::1], f4[:, ::1], f4, f4, u1[:, ::1])", writes=("levels",))
def in_sigmas(band: Floats, contrast2: Floats, noise2: np.float32, share2: np.float32, levels: Bytes) -> None:
    """Write a band (H, W) in sigmas about the middle of 8 bits, by the variance of noise and a share of contrast2."""
    middle = np.float32((HIGHEST + 1) / 2 + 0.5)  # with half a level, as fractions are cut
    for v in range(len(band)):
        for u in range(band.shape[1]):
            level = np.float32(UNITS) * band[v, u] / math.sqrt(noise2 + share2 * contrast2[v, u]) + middle
            levels[v, u] = np.uint8(max(min(level, HIGHEST), NOTHING))


@inner
def half_way(one: int, other: int) -> np.uint8:
    """Return the mean of two bytes, the even one of two that are as near."""
    both = np.uint16(one) + np.uint16(other)
    return np.uint8((both + ((both >> 1) & 1)) >> 1)


@compiled("(u1[:, ::1], f4[::1], u1[:, :, ::1])", writes=("bounds",))
def half_row_bounds(image: Bytes, rows: Floats, bounds: Bytes) -> None:
    """Write the least and the most (2, H, W) within half a row of each pixel of what an image (H, W) shows at rows
    (H,), none of which is above it."""
    last, shown, parts = len(image) - 1, np.empty_like(image), np.uint16(32)
    for v in range(last + 1):
        row, share = divmod(round(parts * rows[v]), parts)
        above, below, rest = image[min(row, last)], image[min(row + 1, last)], np.uint16(parts - share)
        for u in range(image.shape[1]):
            shown[v, u] = np.uint16(above[u] * rest + below[u] * np.uint16(share) + parts // 2) // parts
    for v in range(last + 1):
        above, mine, below = shown[max(v - 1, 0)], shown[v], shown[min(v + 1, last)]
        for u in range(image.shape[1]):
            high, low = half_way(mine[u], above[u]), half_way(mine[u], below[u])
            bounds[0, v, u] = min(mine[u], min(high, low))
            bounds[1, v, u] = max(mine[u], max(high, low))


@inner
def sum_differences(
    lower: Bytes, bounds: Bytes, live: Bytes, first: int, end: int, disparity: int, into: Words
) -> None:
    """Write the sums (W,) of the differences of rows from a first one to an end at a disparity: by how much a pixel
    lies outside of its bounds, at most an outlier's.

    lower (H, W): normalised panorama; bounds (2, H, W): least and most of the upper one about each pixel; live (H, W):
    255 where pixels may be compared, else 0.
    """
    into[:] = NOTHING
    for v in range(first, end):
        mine, may, least, most = lower[v], live[v], bounds[0, v + disparity], bounds[1, v + disparity]
        for u in range(len(into)):
            above = np.uint8(mine[u] - most[u]) if mine[u] > most[u] else np.uint8(0)
            below = np.uint8(least[u] - mine[u]) if least[u] > mine[u] else np.uint8(0)
            into[u] += min(above | below, OUTLIER) & may[u]


@inner
def add_likelihoods(
    sums: Words, best: Words, scale: np.float32, weight: np.float32, into: Floats, total: Floats
) -> None:
    """Write exp(-scale (sums - best)) (W,), and add so many times that to a total (W,)."""
    for u in range(len(into)):
        x = ONE - scale * EXP_SHARE * (np.float32(sums[u]) - np.float32(best[u]))
        x = max(x, NOTHING)
        for _ in range(5):
            x = x * x
        into[u] = x
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
def add_together(sums: Words, count: int, into: Words) -> None:
    """Write the sums (W,) of each direction and of those that follow it, so many together."""
    width = len(sums)
    into[:] = sums
    for m in range(1, count):
        for u in range(width - m):
            into[u] += sums[u + m]
        for u in range(width - m, width):
            into[u] += sums[u + m - width]


@compiled(
    "(u1[:, ::1], u1[:, ::1], u1[:, ::1], u1[:, :, ::1], u1[:, :, ::1], f4[::1], i4[:, ::1], f4[:, :, ::1],"
    " f4[:, ::1], f4[:, :, ::1])",
    writes=("others", "level"),
)
def floor_evidence(
    lower: Bytes,
    upper: Bytes,
    live: Bytes,
    bounds: Bytes,
    on_plane: Bytes,
    plane_rows: Floats,
    patches: Numbers,
    offsets: Floats,
    others: Floats,
    level: Floats,
) -> None:
    """Write the mean likelihood (K, W) of all disparities but the floor's, by that of the floor, and the log-likelihood
    ratios (2, K, W) of the floor to the best level patch above it, and to one below it.

    Where one of many deeper patches fits as well as the floor there is no evidence for it: a floor that repeats itself,
    and falls deep at an edge, fits at some range by another period. Against it counts what is beyond the fit of noise.

    lower, upper (H, W): normalised panoramas. live (H, W): 255 where pixels may be compared, else 0. bounds (2, H, W):
    of the upper one, as of sum_differences; on_plane: those of what it shows on the plane of the floor. plane_rows
    (H,): row of the upper one that shows the floor of a row.
    patches (K, 7): first row and end of the rows of the floor at that disparity, 0 and 0 for none; of the disparities
    the first, the last that is lower than the floor, the first that is higher, and the end; the directions that
    something thin hides: their mean is compared, of a direction and those that follow it.
    offsets (4, K, J): differences of disparity of planes that are the floor, above, just below and deeper, NaN: none;
    what is low is wide, and seven directions are compared.
    """
    width = lower.shape[1]
    sums, floor, next_sums = np.empty(width, np.uint16), np.empty(width, np.uint16), np.empty(width, np.uint16)
    best, value = np.empty((4, width), np.uint16), np.empty(width, np.float32)
    others[:], level[:] = ONE, NOTHING
    for k in range(len(patches)):
        first, end = patches[k, PATCH_FIRST], patches[k, PATCH_END]
        if end <= first:
            continue
        # 1. Upright obstacles at other disparities, of single thin ones.
        together = patches[k, PATCH_THIN]
        others[k], weights = NOTHING, NOTHING
        sum_differences(lower, on_plane, live, first, end, 0, sums)
        add_together(sums, together, floor)
        for d in range(patches[k, PATCH_FROM], patches[k, PATCH_TO]):
            if d <= patches[k, PATCH_LOW] or d >= patches[k, PATCH_HIGH]:
                sum_differences(lower, bounds, live, first, end, d, sums)
                add_together(sums, together, next_sums)
                scale = DIFFERENCE_SCALE / np.float32(together)
                prior = np.float32(math.exp(-abs(d - k) / ADJACENT_PX)) + DISTANT_SHARE
                add_likelihoods(next_sums, floor, scale, prior, value, others[k])
                weights += prior
        others[k] /= weights
        # 2. Planes, in rows between two of the upper panorama.
        best[:] = LARGEST
        for kind in range(4):
            for offset in offsets[kind, k]:
                if math.isnan(offset):
                    continue
                sums[:] = NOTHING
                for v in range(first, end):
                    row = plane_rows[v] + offset
                    above = math.floor(row)
                    share = np.uint16((row - np.float32(above)) * np.float32(256.0))
                    rest = np.uint16(np.uint16(256) - share)
                    for u in range(width):
                        both = np.uint16(upper[above, u]) * rest + np.uint16(upper[above + 1, u]) * share
                        between = np.uint8(np.uint16(both) >> np.uint16(8))
                        other = lower[v, u]
                        apart = np.uint8(max(other, between) - min(other, between))
                        sums[u] += min(apart, OUTLIER) & live[v, u]
                spread(sums, next_sums)
                spread(next_sums, sums)
                spread(sums, next_sums)
                np.minimum(next_sums, best[kind], best[kind])
        for u in range(width):
            floor_sum = np.float32(best[0, u])
            level[0, k, u] = LEVEL_SCALE * (np.float32(best[1, u]) - floor_sum)
            below = LEVEL_SCALE * (np.float32(best[2, u]) - floor_sum)
            deep = LEVEL_SCALE * (np.float32(best[3, u]) - floor_sum)
            deep = deep if deep > NOTHING else min(deep + DEEP_NOISE, NOTHING)
            level[1, k, u] = min(below, deep)


@inner
def add_run(
    before: Floats, mine: Floats, after: Floats, total: Floats, blank: np.float32, run: Floats, best: Floats
) -> None:
    """Go on with the maximum-sum runs (W,) by a strip (Kadane), and raise `best` to them.

    before, mine, after: likelihoods of three neighbouring disparities; total: of all of them. The logarithm is
    approximated by 2 (x^(1/4) - x^(-1/4)); blank: that of the number of the others by these three. A strip without
    texture, and one that fits at two disparities, is no evidence.
    """
    for u in range(len(run)):
        three = before[u] + mine[u] + after[u]
        others = max(total[u] - three, LEAST_LIKELIHOOD)
        root = np.float32(math.sqrt(math.sqrt((three + LEAST_LIKELIHOOD) / others)))
        ratio = np.float32(2.0) * (root - ONE / root)
        without = ratio + blank
        ratio = ratio if ratio > NOTHING else (without if without < NOTHING else NOTHING)
        run[u] = max(run[u] + max(min(ratio, STRIP_BOUND), -STRIP_BOUND) - STRIP_PRIOR, NOTHING)
        best[u] = max(run[u], best[u])


@compiled("(u1[:, ::1], u1[:, ::1], u1[:, :, ::1], u1[:, :, ::1], i4[:, ::1], f4[:, ::1])", writes=("surface",))
def surface_evidence(
    lower: Bytes, live: Bytes, bounds: Bytes, on_plane: Bytes, strips: Numbers, surface: Floats
) -> None:
    """Write the best run (K, W) of strips of rows that are a surface, as a log-likelihood ratio.

    Panoramas as for floor_evidence. strips (N, 6), from above, each with the second half of the one before: first row
    and end; first disparity that is a surface within the robot's heights, and end of the disparities, which never
    rises; 1 where the floor is an explanation, too; end of the disparities that lie below the floor.
    """
    bins, width = surface.shape
    sums, second = np.empty((bins, width), np.uint16), np.zeros((bins, width), np.uint16)
    floor = np.empty((2 * MOVED_ROWS + 1, width), np.uint16)
    half, best = np.empty(width, np.uint16), np.empty(width, np.uint16)
    value, total = np.zeros((bins + 2, width), np.float32), np.empty(width, np.float32)
    run, plain = np.zeros((bins, width), np.float32), np.empty(width, np.float32)
    surface[:] = NOTHING
    for n in range(len(strips)):
        first, end = strips[n, STRIP_FIRST], strips[n, STRIP_END]
        mine, last, below = strips[n, STRIP_SURFACE], strips[n, STRIP_SHIFTS], strips[n, STRIP_BELOW]
        middle = (first + end) // 2
        # 1. The differences, and the least of them.
        best[:], total[:], value[last + 1] = LARGEST, NOTHING, NOTHING
        for d in range(last):
            if n == 0:
                sum_differences(lower, bounds, live, first, middle, d, second[d])
            sum_differences(lower, bounds, live, middle, end, d, half)
            for u in range(width):
                both = np.uint16(second[d, u] + half[u])
                sums[d, u], second[d, u] = both, half[u]
                best[u] = min(both, best[u])
        # 2. The likelihoods of the floor and of all disparities.
        weights = below * BELOW_WEIGHT + (last - below)
        if strips[n, STRIP_FLOOR] > 0:
            for m in range(len(floor)):
                sum_differences(lower, on_plane, live, first, end, m - MOVED_ROWS, floor[m])
                np.minimum(floor[m], best, best)
            for m in range(len(floor)):
                add_likelihoods(floor[m], best, DIFFERENCE_SCALE, FLOOR_WEIGHT, plain, total)
                weights += FLOOR_WEIGHT
        for d in range(last):
            add_likelihoods(sums[d], best, DIFFERENCE_SCALE, BELOW_WEIGHT if d < below else ONE, value[d + 1], total)
        # 3. The runs.
        fourth = math.pow((weights - 3.0) / 3.0, 0.25)
        blank = np.float32(2.0 * (fourth - 1.0 / fourth))
        for d in range(mine, last):
            add_run(value[d], value[d + 1], value[d + 2], total, blank, run[d], surface[d])


@compiled(
    "(u1[:, ::1], u1[:, ::1], u1[:, ::1], f4[::1], i4[:, ::1], f8[::1], f8, f8, f8, f8, f8, f8[::1], f8[::1],"
    " f8[:, :, ::1], f8[:, :, ::1])",
    writes=("ramps", "upright"),
)
def ramp_gains(
    lower: Bytes,
    upper: Bytes,
    live: Bytes,
    plane_rows: Floats,
    parts: Numbers,
    along: Doubles,
    row0: float,
    focal_px: float,
    height_m: float,
    baseline_m: float,
    seen_m: float,
    starts_m: Doubles,
    slopes: Doubles,
    ramps: Doubles,
    upright: Doubles,
) -> None:
    """Write by how much the rows of parts of the way differ less on ramps, and on what is upright, than on the floor.

    lower, upper, live (H, W): normalised panoramas, and 255 where pixels may be compared; plane_rows (H,): row of the
    upper one that shows the floor of a row, row0: the horizon. parts (P, C): directions, along (W,): cosines of all
    against the way. starts_m (X,), slopes (S,) of ramps, seen up to the range seen_m. ramps (P, X, S). upright
    (P, K, H): by disparity, in each row above its foot.
    """
    height, most = len(lower), float(OUTLIER)
    # Of each ramp: disparity by the angle below its horizon [px], and that angle at the range up to which it is seen.
    by_lift, least_lift = np.empty((len(starts_m), len(slopes))), np.empty((len(starts_m), len(slopes)))
    for x in range(len(starts_m)):
        for s in range(len(slopes)):
            below_m = height_m + slopes[s] * starts_m[x]
            by_lift[x, s], least_lift[x, s] = baseline_m / below_m, focal_px * below_m / seen_m
    for p in range(len(parts)):
        ramps[p], upright[p] = 0.0, 0.0
        for u in parts[p]:
            column, rise = upper[:, u].astype(np.float64), focal_px * slopes * along[u]
            for v in range(int(row0) + 1, height):
                on_floor = plane_rows[v]
                if live[v, u] == 0 or on_floor > height - 2:
                    continue
                fall, mine, above = v - row0, float(lower[v, u]), int(on_floor)
                share = on_floor - above
                floor = min(abs(mine - (1.0 - share) * column[above] - share * column[above + 1]), most)
                for k in range(math.ceil(baseline_m / height_m * fall), min(upright.shape[1], height - v)):
                    upright[p, k, v] += floor - min(abs(mine - column[v + k]), most)
                for x in range(len(starts_m)):
                    # Before the start the floor is what it was.
                    if fall * starts_m[x] > focal_px * height_m * along[u]:
                        break
                    for s in range(len(slopes)):
                        lift = fall + rise[s]
                        row = v + by_lift[x, s] * lift
                        if lift < least_lift[x, s] or lift <= 0.0 or row >= height - 1:
                            continue
                        above = int(row)
                        share = row - above
                        shown = (1.0 - share) * column[above] + share * column[above + 1]
                        ramps[p, x, s] += floor - min(abs(mine - shown), most)
