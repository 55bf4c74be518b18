"""Ends of the floor that a ring of obstacles shows, beyond which nothing is known. Plain Python, as the monitor."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Final, NamedTuple

from omnid.core.control.collision_geometry import long_runs

# Floor that is seen so far is open; a ring may end nearer than that, and nothing is known beyond.
FAR_M: Final = 5.0
UNKNOWN_SECTORS: Final = 5  # consecutive ones that make a direction unknown; by trial on development seeds


class UnknownEnd(NamedTuple):
    """End of the floor that was seen in a sector of a ring."""

    sector: int
    free_m: float
    is_gap: bool  # a surface is seen beyond it


def unknown_ends(ranges_m: Sequence[float], free_m: Sequence[float], stop_m: float) -> list[UnknownEnd]:
    """Return the sectors in which nothing is known beyond the floor that was seen.

    ranges_m (N,): of obstacles, inf: free, NaN: unknown; free_m (N,): up to which floor was seen, empty: the range, 0
    where that is unknown. stop_m: length without floor before a surface that belongs to the surface.
    """
    free = free_m if len(free_m) == len(ranges_m) else [r if math.isfinite(r) else 0.0 for r in ranges_m]
    # A surface that is seen past a place that is not, such as a wall behind a plain pole, makes that no freer.
    has_gap = [math.isfinite(r) and r - f > stop_m for r, f in zip(ranges_m, free, strict=True)]
    parts = zip(ranges_m, free, has_gap, strict=True)
    unknown = [gap or math.isnan(r) or (math.isinf(r) and 0.0 < f < FAR_M) for r, f, gap in parts]
    return [UnknownEnd(k, free[k], has_gap[k]) for k in long_runs(unknown, UNKNOWN_SECTORS)]
