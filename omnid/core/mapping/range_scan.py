"""Range scan: the nearest obstacle in each direction, as a planar laser scanner would see it.

`point_scan` computes the scan of the points of a pair, for the map and its keyframes. Points of the floor, and those
under which the robot passes, are removed by their height, with a margin that grows with the range: by the noise of
stereo along the slanting ray, and by the tilt of the base. Points are counted in bins of inverse range, in which the
noise of stereo is the same at all ranges (sigma_r = r^2 / (f t) sigma_d).
"""

from __future__ import annotations

import math
from typing import Final

import numpy as np
from numpy.typing import NDArray

from calib import se3

Array = NDArray[np.float64]

# Sectors of one degree are as wide as a cell of the map, 5 cm, at 3 m.
SECTORS: Final = 360
# Points of a keyframe that are farther away do not enter its scan; by trial on development seeds.
MAX_RANGE_M: Final = 12.0
# Longest gap that is filled between two sectors of one surface: 0.2 m at 3 m, too narrow for a person.
FILLED_SECTORS: Final = 4
# The ranges on both sides of a gap belong to one surface if their ratio is at most this; by trial on development seeds.
SURFACE_RATIO: Final = 1.15

INVERSE_STEP: Final = 0.02  # width of a bin [1/m]: two of them are about four sigma of a usual rig
NEAREST_M: Final = 0.2  # Range of the first bin, from the middle of the base.

# Ranges (SECTORS,) [m] of the sectors in the order of azimuth, from -pi on. NaN: no obstacle was seen.
RangeScan = NDArray[np.float32]
# Ranges (SECTORS,) [m] in the same order, up to which the floor was seen without anything on it; 0: nowhere.
FreeRanges = NDArray[np.float32]


def azimuths() -> Array:
    """Return the azimuths (SECTORS,) [rad] of the sectors' middles."""
    return np.asarray((np.arange(SECTORS) + 0.5) * (2 * math.pi / SECTORS) - math.pi)


def seen_from(free_m: FreeRanges, T_view_base: Array) -> FreeRanges:
    """Return free ranges around a base as seen from a viewpoint on it: the floor that is free from both.

    T_view_base (4, 4): from the base to the viewpoint, both level and on the floor [m].
    """
    directions = np.column_stack([np.cos(azimuths()), np.sin(azimuths()), np.zeros(SECTORS)])
    x, y, _ = se3.apply(T_view_base, free_m[:, None] * directions).T
    nearest = np.full(SECTORS, np.inf)
    np.minimum.at(nearest, _sectors(x, y), np.where(free_m > 0, np.hypot(x, y), 0.0))
    # The end of a free range may lie on the border of two sectors: it counts for the sectors on both sides.
    nearest = np.minimum(nearest, np.minimum(np.roll(nearest, 1), np.roll(nearest, -1)))
    return np.where(np.isfinite(nearest), nearest, 0.0).astype(np.float32)


def point_scan(
    points: Array,
    sigma_m: Array,
    view: Array,
    heights_m: tuple[float, float],
    tilt_rad: float,
    min_points: int,
) -> RangeScan:
    """Return the scan (SECTORS,) of points (N, 3) [m] in the level frame of the base; z is the height above the floor.

    A range is that of the nearest obstacle up to MAX_RANGE_M, m; NaN: unknown.
    sigma_m (N,): of the points, along the rays; view (3,): the viewpoint in that frame; heights_m: of obstacles above
    the floor; tilt_rad: sigma of the base's tilt against it; min_points: least number of points of an obstacle.
    """
    # 1. The points within the band of heights, by a margin of two sigma for the noise of stereo and the tilt of the
    #    base: 2 % of the points of the floor are beyond it.
    low, high = heights_m
    across2, rise2 = ((points[:, :2] - view[:2]) ** 2).sum(axis=1), (points[:, 2] - view[2]) ** 2
    stereo_variance = sigma_m**2 * rise2 / np.maximum(across2 + rise2, 1e-12)
    margin = 2 * np.sqrt(stereo_variance + tilt_rad**2 * across2)
    x, y, z = points.T
    ranges = np.hypot(x, y)
    chosen = (ranges > NEAREST_M) & np.isfinite(sigma_m) & (z - margin > low) & (z + margin < high)
    # 2. Sums over bins of inverse range, bin 0 the nearest; an obstacle may lie across the border of two bins.
    bins = math.ceil(1 / (NEAREST_M * INVERSE_STEP))
    inverse = 1 / ranges[chosen]
    far_bin = np.clip(bins - 1 - np.floor(inverse / INVERSE_STEP).astype(np.intp), 0, bins - 1)
    index = _sectors(x[chosen], y[chosen]) * bins + far_bin
    sums = [np.bincount(index, weights, SECTORS * bins).reshape(SECTORS, bins) for weights in (None, inverse)]
    count, inverse = (each + np.pad(each[:, 1:], ((0, 0), (0, 1))) for each in sums)
    # 3. The nearest bin that enough points support, those of the neighbouring sectors included.
    of_neighbours = count + np.roll(count, 1, axis=0) + np.roll(count, -1, axis=0)
    supported = (of_neighbours >= min_points) & (count > 0)
    first = supported.argmax(axis=1)[:, None]
    point_count, inverse_sum = (np.take_along_axis(each, first, axis=1)[:, 0] for each in (count, inverse))
    found = np.divide(point_count, inverse_sum, out=np.full(SECTORS, np.nan), where=supported.any(axis=1))
    scan = np.where(found > MAX_RANGE_M, np.nan, found).astype(np.float32)
    # 4. Short gaps where the ranges on both sides are those of one surface: sparse stereo measures edges only, so a
    #    plain wall between two edges appears as a gap. A flat wall is linear in 1 / range.
    known = np.flatnonzero(np.isfinite(scan))
    following = np.roll(known, -1)
    gap, a, b = (following - known) % SECTORS - 1, scan[known], scan[following]
    is_surface = (gap >= 1) & (gap <= FILLED_SECTORS) & (np.maximum(a, b) <= SURFACE_RATIO * np.minimum(a, b))
    for step in range(1, FILLED_SECTORS + 1):
        chosen = is_surface & (gap >= step)
        share = step / (gap[chosen] + 1)
        scan[(known[chosen] + step) % SECTORS] = 1 / ((1 - share) / a[chosen] + share / b[chosen])
    return scan


def _sectors(x: Array, y: Array) -> NDArray[np.intp]:
    """Return the sectors (N,) in which points at x (N,), y (N,) [m] from the base lie."""
    return np.floor((np.arctan2(y, x) + math.pi) * (SECTORS / math.tau)).astype(np.intp) % SECTORS
