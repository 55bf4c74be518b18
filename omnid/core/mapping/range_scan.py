"""Range scan: the nearest obstacle in each direction, as a planar laser scanner would see it."""

from __future__ import annotations

import math
from typing import Final

import numpy as np
from numpy.typing import NDArray

from calib import se3

Array = NDArray[np.float64]

# Sectors of one degree are as wide as a cell of the map, 5 cm, at 3 m; finer ones would not show more.
SECTORS: Final = 360
# Points of a keyframe that are farther away do not enter its scan; by trial on development seeds.
MAX_RANGE_M: Final = 12.0
# Longest gap that is filled between two sectors of one surface, because it is 0.2 m wide at 3 m, too narrow for a
# person.
FILLED_SECTORS: Final = 4
# The ranges on both sides of a gap belong to one surface if their ratio is at most this; by trial on development seeds.
SURFACE_RATIO: Final = 1.15

# Ranges (SECTORS,) [m] of the sectors in the order of azimuth, from -pi on. NaN: no obstacle was seen.
RangeScan = NDArray[np.float32]
# Ranges (SECTORS,) [m] in the same order, up to which the floor was seen without anything on it; 0: nowhere. Those of
# keyframes are negative where something narrow, such as a pole, hides the floor from there on (obstacles/narrow.py).
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
    sector = np.floor((np.arctan2(y, x) + math.pi) * (SECTORS / math.tau)).astype(np.intp) % SECTORS
    nearest = np.full(SECTORS, np.inf)
    np.minimum.at(nearest, sector, np.where(free_m > 0, np.hypot(x, y), 0.0))
    # An end between two sectors belongs to either side.
    nearest = np.minimum(nearest, np.minimum(np.roll(nearest, 1), np.roll(nearest, -1)))
    return np.where(np.isfinite(nearest), nearest, 0.0).astype(np.float32)


def fill_gaps(scan: RangeScan) -> RangeScan:
    """Return the scan (SECTORS,) with short gaps filled, where the ranges on both sides are those of one surface.

    Sparse stereo measures edges only, so a plain wall between two edges appears as a gap.
    """
    known = np.flatnonzero(np.isfinite(scan))
    if len(known) < 2:
        return scan
    following = np.roll(known, -1)
    gap = (following - known) % SECTORS - 1
    a, b = scan[known], scan[following]
    is_surface = (gap >= 1) & (gap <= FILLED_SECTORS) & (np.maximum(a, b) <= SURFACE_RATIO * np.minimum(a, b))
    filled = scan.copy()
    for step in range(1, FILLED_SECTORS + 1):
        chosen = is_surface & (gap >= step)
        share = step / (gap[chosen] + 1)
        # A flat wall is linear in 1 / range, as long as the sectors are narrow.
        filled[(known[chosen] + step) % SECTORS] = 1 / ((1 - share) / a[chosen] + share / b[chosen])
    return filled
