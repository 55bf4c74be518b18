"""Range scan of one pair's points: the nearest obstacle in each direction, for the map and its keyframes.

The floor and what is passed below are removed by height, with a margin that grows with the range: by the noise of
stereo along the slanting ray, and by the tilt of the base. Support is counted in bins of inverse range, in which the
noise of stereo is the same at all ranges (sigma_r = r^2 / (f t) sigma_d).
"""

from __future__ import annotations

import math
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from omnid.core.mapping.range_scan import SECTORS, RangeScan, fill_gaps

Array = NDArray[np.float64]
Counts = NDArray[np.intp]

HEIGHT_SIGMAS: Final = 2.0  # Sigmas above the floor from which a point is an obstacle, so that 2 % of the floor's are.
INVERSE_STEP: Final = 0.02  # 1/m: width of a bin, because two of them are about four sigma of a usual rig
NEAREST_M: Final = 0.2  # Range of the first bin, from the middle of the base.


class ScanLimits(NamedTuple):
    """Limits of what is an obstacle, as the settings obstacles.ring give them."""

    heights_m: tuple[float, float]  # range of heights above the floor
    tilt_rad: float  # sigma of the base's tilt against the floor
    max_range_m: float
    min_points: int  # least number of points of an obstacle


def point_scan(points: Array, sigma_m: Array, view: Array, limits: ScanLimits, floor_sigma_m: float = 0.0) -> RangeScan:
    """Return the scan (SECTORS,) of points (N, 3) [m] in the level frame of the base; z is the height above the floor.

    A range is that of the nearest obstacle, m; inf: something beyond the longest range was seen; NaN: unknown.

    sigma_m (N,): of the points, along the rays; view (3,): the viewpoint in that frame; floor_sigma_m: of the floor.
    """
    ranges = np.hypot(points[:, 0], points[:, 1])
    turned = (np.arctan2(points[:, 1], points[:, 0]) + math.pi) * (SECTORS / (2 * math.pi))
    sector = np.floor(turned).astype(np.intp) % SECTORS
    usable = (ranges > NEAREST_M) & np.isfinite(sigma_m)
    chosen = usable & _is_obstacle(points, sigma_m, view, limits, floor_sigma_m)
    found, seen_beyond = _nearest(sector[chosen], ranges[chosen], limits)
    found = fill_gaps(found)
    return np.where(~np.isfinite(found) & seen_beyond, np.inf, found).astype(np.float32)


def _is_obstacle(
    points: Array, sigma_m: Array, view: Array, limits: ScanLimits, floor_sigma_m: float
) -> NDArray[np.bool_]:
    """Return which of points (N, 3) are within the band of heights; the arguments are those of `point_scan`."""
    low, high = limits.heights_m
    away = points - view
    across2 = away[:, 0] ** 2 + away[:, 1] ** 2
    rise2 = away[:, 2] ** 2
    of_stereo2 = sigma_m**2 * rise2 / np.maximum(across2 + rise2, 1e-12)
    margin = HEIGHT_SIGMAS * np.sqrt(of_stereo2 + limits.tilt_rad**2 * across2 + floor_sigma_m**2)
    z = points[:, 2]
    return np.asarray((z - margin > low) & (z + margin < high))


def _nearest(sector: Counts, ranges: Array, limits: ScanLimits) -> tuple[RangeScan, NDArray[np.bool_]]:
    """Return the ranges (SECTORS,) of the nearest supported obstacles, and where something beyond was seen."""
    bins = math.ceil(1 / (NEAREST_M * INVERSE_STEP))
    # Bin 0 is the nearest.
    index = sector * bins + np.clip(bins - 1 - np.floor(1 / (ranges * INVERSE_STEP)).astype(np.intp), 0, bins - 1)
    counts = np.bincount(index, minlength=SECTORS * bins).reshape(SECTORS, bins).astype(float)
    inverse = np.bincount(index, 1 / ranges, SECTORS * bins).reshape(SECTORS, bins).astype(float)
    pair = _with_next(counts)
    supported = (_of_neighbours(pair) >= limits.min_points) & (pair > 0)
    limit = bins - 1 - math.floor(1 / (limits.max_range_m * INVERSE_STEP))  # bins from here on lie beyond
    near = supported[:, : limit + 1]
    first = np.argmax(near, axis=1)
    rows = np.arange(SECTORS)
    known = near[rows, first]
    with np.errstate(divide="ignore", invalid="ignore"):
        found = np.where(known, pair[rows, first] / _with_next(inverse)[rows, first], np.nan)
    # The last two bins reach beyond the longest range.
    is_beyond = found > limits.max_range_m
    found[is_beyond] = np.nan
    return found.astype(np.float32), is_beyond | (~known & supported[:, limit + 1 :].any(axis=1))


def _with_next(sums: Array) -> Array:
    """Return the sums of each bin and the next farther one."""
    total = sums.astype(float)
    total[:, :-1] += sums[:, 1:]
    return total


def _of_neighbours(sums: Array) -> Array:
    """Return the sums over each sector and its two neighbours."""
    return np.asarray(sums + np.roll(sums, 1, axis=0) + np.roll(sums, -1, axis=0))
