"""Grid stage: the occupancy grid of the map, drawn from the range scans of its keyframes."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from omnid.core.mapping.scan_grid import KeyframeGrid
from omnid.load_level import Load, LoadLevel, full_load
from omnid.messages import GridUpdate, PlaceUpdate

Array = NDArray[np.float64]


class MapGrid:
    """Draw the map periodically and at the end, where it has changed: it moves when a loop closes."""

    def __init__(self, cell_m: float, T_base_rect: Array, every_s: float = 0.0, load: Load = full_load) -> None:
        """cell_m: side of a cell. every_s: time between two grids, by the stamps; 0: one grid, at the end."""
        self._grid, self._T_base_rect = KeyframeGrid(cell_m), T_base_rect
        self._every_ns, self._given_ns = round(every_s * 1e9), 0
        self._load = load
        self._given: object = None  # scans of the last grid
        self._newest: PlaceUpdate | None = None

    def process(self, update: PlaceUpdate) -> GridUpdate | None:
        """Return the grid when it is due and has changed."""
        if not update.is_known:  # where these scans lie in the map is unknown
            return None
        self._newest = update
        if not self._every_ns or update.stamp_ns - self._given_ns < self._every_ns or update.scans is self._given:
            return None
        return None if self._load() >= LoadLevel.NO_MAP else self._drawn(update)

    def finish(self) -> list[GridUpdate]:
        """Return the final grid, if there was a keyframe."""
        newest = self._newest
        if newest is None or newest.scans is None or not newest.scans.scans or newest.scans is self._given:
            return []
        return [self._drawn(newest)]

    def _drawn(self, update: PlaceUpdate) -> GridUpdate:
        assert update.scans is not None
        self._given_ns, self._given = update.stamp_ns, update.scans
        return GridUpdate(update.seq, update.stamp_ns, self._grid.draw(update.scans, self._T_base_rect))
