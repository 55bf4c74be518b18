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
FLOOR_FIRST, FLOOR_END, FLOOR_FROM, FLOOR_LOW, FLOOR_HIGH, FLOOR_TO, FLOOR_THIN = 0, 1, 2, 3, 4, 5, 6


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
def add_next(sums: Words, count: int, into: Words) -> None:
    """Write the sums (W,) of each direction and of those that follow it, so many together."""
    width = len(sums)
    for u in range(width):
        into[u] = sums[u]
    for m in range(1, count):
        for u in range(width - m):
            into[u] = np.uint16(into[u] + sums[u + m])
        for u in range(width - m, width):
            into[u] = np.uint16(into[u] + sums[u + m - width])


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


@compiled(
    "(u1[:, ::1], u1[:, ::1], f4[::1], u1[:, ::1], i4[:, ::1], f4[:, :, ::1], u1, f4, f4, f4[:, :, ::1])",
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
    fit_of_noise: np.float32,
    ratios: Floats,
) -> None:
    """Write the log-likelihood ratios (2, K, W) of the floor to the best level patch above it, and to one below it.

    Where one of many deeper patches fits as well as the floor there is no evidence for it: a floor that repeats itself,
    and falls deep at an edge, fits at some range by another period. Against it counts what is beyond the fit of noise.

    lower, upper (H, W): normalised panoramas; plane (H,): row of the upper one that shows the floor of a row. live,
    bins: as for floor_evidence. offsets (4, K, J): differences of disparity of patches of the floor, above, just below
    and deeper, NaN: no more; scale: logarithm of the likelihood by a unit of difference, by 64; fit_of_noise:
    log-likelihood by which the best of the deeper patches may fit better by noise.
    """
    width = lower.shape[1]
    sums, wide = np.zeros(width, np.uint16), np.empty(width, np.uint16)
    best = np.empty((4, width), np.uint16)
    ratios[:] = NOTHING
    for k in range(len(bins)):
        if bins[k, FLOOR_END] <= bins[k, FLOOR_FIRST]:
            continue
        best[:] = LARGEST
        for kind in range(4):
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
        for u in range(width):
            floor = np.float32(best[0, u])
            ratios[0, k, u] = scale * (np.float32(best[1, u]) - floor)
            below, deep = np.float32(best[2, u]) - floor, np.float32(best[3, u]) - floor
            against = scale * deep + fit_of_noise
            deep = scale * deep if deep > NOTHING else (against if against < NOTHING else NOTHING)
            below = scale * below
            ratios[1, k, u] = deep if below > deep else below


@compiled(
    "(u1[:, ::1], u1[:, :, ::1], u1[:, :, ::1], u1[:, ::1], i4[:, ::1], u1, f4, f4[::1], f4[:, ::1])",
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
    prior: Floats,
    others: Floats,
) -> None:
    """Write the mean likelihood (K, W) of all disparities but the floor's, by that of the floor.

    lower (H, W): normalised lower panorama; upright, plane (2, H, W): least and most of the upper one about each pixel,
    and on the plane of the floor. live (H, W): 255 where pixels may be compared, else 0.
    bins (K, 7): first row and end of the rows of the floor at that disparity, 0 and 0 for none; of the disparities the
    first, the last that is lower than the floor, the first that is higher, and the end; the directions that something
    thin hides: their mean is compared, of a direction and those that follow it.
    outlier: most that a pixel differs; scale: logarithm of the likelihood by a unit of difference; prior: weight of a
    disparity by its difference from the floor's.
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
        together = bins[k, FLOOR_THIN]
        mean_scale = scale / np.float32(together)
        add_next(floor, together, wide_floor)
        for d in range(begin, last):
            if d <= low or d >= high:
                add_next(sums[d], together, wide)
                likelihoods(wide, wide_floor, mean_scale, value)
                add(value, prior[abs(d - k)], others[k])
                weights += prior[abs(d - k)]
        for u in range(width):
            others[k, u] /= weights
