"""Directions of the base in which the images show nothing to rely on, and what that makes of a ring."""

from __future__ import annotations

import math
from typing import Final

import numpy as np
from numpy.typing import NDArray

from calib.panorama import Cylinder
from omnid.core.mapping.range_scan import SECTORS
from omnid.core.obstacles.grid import GridRing
from omnid.core.stereo.tiles import tile_columns

Array = NDArray[np.float64]
Flags = NDArray[np.bool_]

# A direction of the cameras is one of the base only far away, because the viewpoint may lie off the base's origin.
RANGES_M: Final = (0.3, 0.6, 1.2, 2.5, 5.0)
SAMPLES: Final = 13  # across a tile of 6 degrees, so that each sector has two


class Unwatched:
    """Maps columns of tiles to sectors of the ring."""

    def __init__(self, cylinder: Cylinder, T_base_rect: Array) -> None:
        """T_base_rect (4, 4): from the rectified frame to the base."""
        within, count = np.linspace(0.0, 1.0, SAMPLES), tile_columns(cylinder)
        columns = (np.arange(count)[:, None] + within) * (cylinder.width / count) - 0.5
        pixels = np.column_stack([columns.ravel(), np.full(columns.size, cylinder.row0)])
        direction = cylinder.rays(pixels) @ T_base_rect[:3, :3].T
        places = np.array(RANGES_M)[:, None, None] * direction[:, :2] + T_base_rect[:2, 3]
        self._sectors = _sectors_of(places).reshape(len(RANGES_M), count, SAMPLES)
        self._directions = _sectors_of(direction).reshape(count, SAMPLES)

    def sectors(self, columns: Flags) -> Flags:
        """Return the sectors (SECTORS,) of columns of tiles (C,)."""
        found = np.zeros(SECTORS, bool)
        found[self._sectors[:, np.flatnonzero(columns)]] = True
        return found

    def directions(self, columns: Flags) -> Flags:
        """Return the directions (SECTORS,) from the viewpoint, about axes parallel to the base's, of columns (C,)."""
        found = np.zeros(SECTORS, bool)
        found[self._directions[np.flatnonzero(columns)]] = True
        return found

    def spans_deg(self, columns: Flags) -> list[tuple[int, int]]:
        """Return from where to where columns of tiles lie about the base, counter-clockwise from ahead [deg]."""
        marked = np.zeros(SECTORS, bool)
        marked[self._sectors[-1, np.flatnonzero(columns)]] = True
        if marked.all():
            return [(0, 360)]
        begins = np.flatnonzero(marked & ~np.roll(marked, 1))
        ends = np.flatnonzero(marked & ~np.roll(marked, -1))
        if len(ends) and ends[0] < begins[0]:
            ends = np.roll(ends, -1)
        # Sector 0 is behind.
        return [((int(begin) - 180) % 360, (int(end) + 1 - 180) % 360) for begin, end in zip(begins, ends, strict=True)]


def _sectors_of(places: Array) -> NDArray[np.intp]:
    turned = (np.arctan2(places[..., 1], places[..., 0]) + math.pi) * (SECTORS / (2 * math.pi))
    return np.asarray(np.floor(turned).astype(np.intp) % SECTORS)


def without(ring: GridRing, unwatched: Flags, unseen: Flags) -> GridRing:
    """Return the ring without what is said about unwatched sectors (SECTORS,): no range, and no free floor.

    unseen (SECTORS,): the same directions from the viewpoint, in which no floor can be hidden.
    """
    if not unwatched.any():
        return ring
    nan = np.float32(np.nan)
    return GridRing(
        np.where(unwatched, nan, ring.ranges_m),
        np.where(unwatched, nan, ring.sigma_m),
        np.where(unwatched, np.float32(0), ring.free_m),
        ring.arrivals._replace(ranges_m=np.where(unseen, nan, ring.arrivals.ranges_m)),
    )
