"""Ring around the base by the cells of the grid: along each direction the nearest obstacle, and the free floor."""

from __future__ import annotations

from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from omnid.core.obstacles import grid_kernels as kernels
from omnid.core.obstacles.usual_floor import Arrivals
from omnid.core.obstacles.watch import NARROW_CELLS

Array = NDArray[np.float64]
Floats = NDArray[np.float32]
Bytes = NDArray[np.uint8]

# Distance kept before the end of the free floor, because at the foot of an object patches show both.
END_M: Final = 0.1
# Share of the longest range from which on a direction is open, because few pairs show the last cells.
OPEN_SHARE: Final = 0.9


class GridRing(NamedTuple):
    """Nearest obstacles and free floor around the base, by the grid."""

    ranges_m: Floats  # (SECTORS,) nearest surface; inf: floor up to the longest range; NaN: unknown
    sigma_m: Floats  # (SECTORS,) of the ranges, NaN without one
    free_m: Floats  # (SECTORS,) up to which the way is free
    arrivals: Arrivals  # of this pair


class RingView(NamedTuple):
    """Directions from a place in the grid, and the gaps in the floor that are passed."""

    place: Array  # (2,) in cells
    angles: Array  # (N,) of the directions, in the axes of the grid
    cell_m: float
    max_range_m: float
    nearest_m: Array  # (N,) of the floor in view
    gap_share: float  # of the range, that what is lower than an obstacle may hide: such gaps are passed
    gap_m: float  # least gap that is passed


def circle_from(directions: Array, middle_m: Array, radius_m: float) -> Array:
    """Return the way (N,) from the origin along directions (N, 2) to a circle around it, whose middle lies off it."""
    along_m = directions @ middle_m
    return np.asarray(along_m + np.sqrt(np.maximum(radius_m**2 - middle_m @ middle_m + along_m**2, 0.0)))


def ring_of(cells: Bytes, view: RingView, arrivals: Arrivals) -> GridRing:
    """Return the ring by the cells (H, W): 0 unknown, 1 free, 2 taken."""
    first, hit, free = np.empty((3, len(view.angles)))
    # 1. Up to the first taken cell, and to the end of the free floor.
    origin = np.array(
        [*view.place, view.cell_m / 2, view.max_range_m, view.cell_m, view.gap_share, view.gap_m], np.float64
    )
    kernels.march(cells, origin, view.angles, first, free)
    # Too near for floor, a part of a surface that shows nothing, such as a white margin, is no opening.
    kernels.close_openings(first, free, view.nearest_m, NARROW_CELLS * view.cell_m, END_M + view.cell_m, hit)
    # 2. A direction between cells may belong to either side.
    around = np.concatenate([free[-1:], free, free[:1]])
    free = np.minimum(free, np.minimum(around[:-2], around[2:]))
    is_open = np.isinf(hit) & (free >= OPEN_SHARE * view.max_range_m)
    ranges = np.where(np.isfinite(hit), hit, np.where(is_open, np.inf, np.nan))
    sigma = np.where(np.isfinite(ranges), view.cell_m / 2, np.nan)
    # 3. What stands at an end may be nearer: in view, by its foot; an end nearer than that, found before, by a cell.
    end_m = np.where(free > view.nearest_m, np.minimum(END_M, free - view.nearest_m + view.cell_m), view.cell_m)
    free = np.where(free < hit, np.maximum(free - end_m, 0.0), hit)
    return GridRing(ranges.astype(np.float32), sigma.astype(np.float32), free.astype(np.float32), arrivals)
