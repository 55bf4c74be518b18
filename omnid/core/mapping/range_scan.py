"""Range scan: the nearest obstacle in each direction, as a planar laser scanner would see it."""

from __future__ import annotations

import math
from typing import Final

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

SECTORS: Final = 360  # one a degree: 5 cm at 3 m, the size of a cell, is fine enough
MAX_RANGE_M: Final = 12.0  # of keyframes; by trial on development seeds
# Longest gap that is filled between two sectors of one surface; 0.2 m at 3 m: too narrow for a person.
FILLED_SECTORS: Final = 4
SURFACE_RATIO: Final = 1.15  # of the ranges on both sides of such a gap, at most; by trial on development seeds

RangeScan = NDArray[np.float32]  # (SECTORS,) m, from azimuth -pi on; NaN: nothing was seen there


def azimuths() -> Array:
    """Return the azimuths (SECTORS,) [rad] of the sectors' middles."""
    return np.asarray((np.arange(SECTORS) + 0.5) * (2 * math.pi / SECTORS) - math.pi)


def fill_gaps(scan: RangeScan) -> RangeScan:
    """Return the scan with short gaps filled, if the ranges on both sides are those of one surface.

    Stereo sees edges: a wall between two of them is no gap.
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
