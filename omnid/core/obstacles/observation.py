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
from omnid.core.obstacles.settings import RingSettings

Array = NDArray[np.float64]
Counts = NDArray[np.intp]

HEIGHT_SIGMAS: Final = 2.0  # of the height, between the floor and an obstacle
INVERSE_STEP: Final = 0.02  # 1/m: width of a bin; two of them are about four sigma of a usual rig
NEAREST_M: Final = 0.2  # of the bins


class Observation(NamedTuple):
    """Ring of one pair, in the base frame."""

    ranges_m: RangeScan  # (SECTORS,) nearest obstacle; inf: something beyond the longest range was seen; NaN: unknown
    sigma_m: RangeScan  # (SECTORS,) of the ranges; NaN without one


def observe(points: Array, sigma_m: Array, view: Array, settings: RingSettings, floor_sigma_m: float = 0.0
            ) -> Observation:
    """Return the ring of points (N, 3) [m] in the level frame of the base, whose z is the height above the floor.

    sigma_m (N,): of the points, along the rays; view (3,): the viewpoint in that frame; floor_sigma_m: of the floor.
    """
    ranges = np.hypot(points[:, 0], points[:, 1])
    turned = (np.arctan2(points[:, 1], points[:, 0]) + math.pi) * (SECTORS / (2 * math.pi))
    sector = np.floor(turned).astype(np.intp) % SECTORS
    usable = (ranges > NEAREST_M) & np.isfinite(sigma_m)
    chosen = usable & _is_obstacle(points, sigma_m, view, settings, floor_sigma_m)
    found, sigma, seen_beyond = _nearest(sector[chosen], ranges[chosen], sigma_m[chosen], settings)
    found = fill_gaps(found)
    sigma = np.where(np.isfinite(found) & ~np.isfinite(sigma), _carried(sigma), sigma)
    is_open = ~np.isfinite(found) & seen_beyond
    result = np.where(is_open, np.inf, found).astype(np.float32)
    return Observation(result, sigma.astype(np.float32))


def _is_obstacle(points: Array, sigma_m: Array, view: Array, settings: RingSettings, floor_sigma_m: float
                 ) -> NDArray[np.bool_]:
    """Return which of points (N, 3) are within the band of heights; the arguments are those of `observe`."""
    low, high = settings.heights_m
    away = points - view
    across2 = away[:, 0] ** 2 + away[:, 1] ** 2
    rise2 = away[:, 2] ** 2
    of_stereo2 = sigma_m**2 * rise2 / np.maximum(across2 + rise2, 1e-12)
    margin = HEIGHT_SIGMAS * np.sqrt(of_stereo2 + math.radians(settings.tilt_deg) ** 2 * across2 + floor_sigma_m**2)
    z = points[:, 2]
    return np.asarray((z - margin > low) & (z + margin < high))


def _nearest(sector: Counts, ranges: Array, sigma_m: Array, settings: RingSettings
             ) -> tuple[RangeScan, RangeScan, NDArray[np.bool_]]:
    """Return range and sigma (SECTORS,) of the nearest supported obstacles, and where something beyond was seen."""
    bins = math.ceil(1 / (NEAREST_M * INVERSE_STEP))
    # Bin 0 is the nearest.
    index = sector * bins + np.clip(bins - 1 - np.floor(1 / (ranges * INVERSE_STEP)).astype(np.intp), 0, bins - 1)
    counts = np.bincount(index, minlength=SECTORS * bins).reshape(SECTORS, bins).astype(float)
    inverse = np.bincount(index, 1 / ranges, SECTORS * bins).reshape(SECTORS, bins).astype(float)
    noise = np.bincount(index, sigma_m / ranges**2, SECTORS * bins).reshape(SECTORS, bins).astype(float)
    pair = _with_next(counts)
    supported = (_of_neighbours(pair) >= settings.min_points) & (pair > 0)
    limit = bins - 1 - math.floor(1 / (settings.max_range_m * INVERSE_STEP))  # bins from here on lie beyond
    near = supported[:, : limit + 1]
    first = np.argmax(near, axis=1)
    rows = np.arange(SECTORS)
    known = near[rows, first]
    with np.errstate(divide="ignore", invalid="ignore"):
        count = pair[rows, first]
        found = np.where(known, count / _with_next(inverse)[rows, first], np.nan)
        sigma = np.where(known, found**2 * _with_next(noise)[rows, first] / count, np.nan)
    return found.astype(np.float32), sigma.astype(np.float32), ~known & supported[:, limit + 1 :].any(axis=1)


def _with_next(sums: Array) -> Array:
    """Return the sums of each bin and the next farther one."""
    total = sums.astype(float)
    total[:, :-1] += sums[:, 1:]
    return total


def _of_neighbours(sums: Array) -> Array:
    """Return the sums over each sector and those beside it."""
    return np.asarray(sums + np.roll(sums, 1, axis=0) + np.roll(sums, -1, axis=0))


def _carried(sigma: RangeScan) -> RangeScan:
    """Return for each sector the sigma of the nearest known sector before it, NaN where there is none."""
    known = np.flatnonzero(np.isfinite(sigma))
    if not len(known):
        return sigma
    before = np.searchsorted(known, np.arange(SECTORS), side="right") - 1
    return sigma[known[before]]
