"""Something narrow and upright by one pair: it hides the floor behind it, which is seen on either side of it.

What is plain shows nothing itself, and the grid's log-odds of a cell come from all places: floor that a pole hides is
seen beside it from the next one. docs/obstacles.md has them.
"""

from __future__ import annotations

import math
from typing import Final

import numpy as np
from numpy.typing import NDArray

from omnid.core.mapping.range_scan import SECTORS, FreeRanges
from omnid.core.obstacles.column import THIN_M

Floats = NDArray[np.float32]

# Directions on either side whose floor is compared, because nearer ones may show a thing of 10 cm at 1 m, and farther
# ones another floor.
BESIDE: Final = range(5, 13)
MOST_RATIO: Final = 3.0  # of the floor by one patch, because the errors of neighbours are alike
# Log-odds of a direction from which something narrow stands there. By trial on development seeds: with 4 less floor of
# maps is free, with 6 twice as many cells of poles are.
NARROW_SUM: Final = 5.0
# Part of the log-odds without any evidence, because a little less evidence than beside it is not hidden floor.
NARROW_SHARE: Final = 0.5
# Disparities before the first one that is hidden at which its foot may be, because patches there show the floor before
# it: 1.3 to 5.3 of them in 90 % of the views of poles, development seed 1.
FOOT_BINS: Final = 5
STEPS: Final = 4  # Of a direction, so that all sectors that it covers are found.


def nothing_narrow() -> FreeRanges:
    """Return the ranges of a pair that shows nothing narrow."""
    return np.full(SECTORS, np.inf, np.float32)


def narrow_m(floor: Floats, at_1m: float) -> FreeRanges:
    """Return the least range (SECTORS,) [m] at which something narrow hides floor, inf where nothing does.

    floor (K, W): evidence of a pair by disparity and direction; at_1m: disparity at 1 m. Sectors are those of the
    rectified frame.
    """
    seen = np.where(np.isfinite(floor), np.clip(floor, -MOST_RATIO, MOST_RATIO), np.float32(0))
    # 1. The usual evidence of a patch is that beside it: on both sides, as the floor may end on one.
    usual = np.maximum(np.minimum(_mean_beside(seen, 1), _mean_beside(seen, -1)), 0)
    odds = np.where(np.isfinite(floor), np.clip(usual / 2 * (usual / 2 - seen), -MOST_RATIO, MOST_RATIO), 0)
    # 2. What stands there hides all floor behind it: the sum from far away is largest where it begins.
    sums, without = np.cumsum(odds, axis=0), np.cumsum(usual**2 / 4, axis=0)
    every = np.arange(floor.shape[1])
    begin = sums.argmax(axis=0)
    stands = sums[begin, every] > np.maximum(NARROW_SUM, NARROW_SHARE * without[begin, every])
    # 3. By sectors, of all directions that are judged together.
    found = nothing_narrow()
    for u in np.flatnonzero(stands):
        together = max(round(THIN_M * (begin[u] + 0.5) / at_1m * len(every) / math.tau), 1)
        covered = np.arange(STEPS * together + 1) / STEPS + u  # from the first side of u to the last one
        sectors = np.floor(SECTORS * (1 - covered / len(every))).astype(np.intp) % SECTORS
        found[sectors] = np.minimum(found[sectors], at_1m / (begin[u] + FOOT_BINS))
    return found


def _mean_beside(seen: Floats, side: int) -> Floats:
    """Return the mean evidence (K, W) of the directions on one side: 1 or -1."""
    return np.asarray(np.mean([np.roll(seen, side * shift, axis=1) for shift in BESIDE], axis=0), np.float32)
