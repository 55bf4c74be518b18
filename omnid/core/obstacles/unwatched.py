"""Directions of the base in which the images show nothing to rely on."""

from __future__ import annotations

import math
from typing import Final

import numpy as np
from numpy.typing import NDArray

from calib.panorama import Cylinder
from omnid.core.mapping.range_scan import SECTORS
from omnid.core.stereo.tiles import tile_columns

Array = NDArray[np.float64]
Flags = NDArray[np.bool_]

# A direction of the cameras is one of the base only far away, because the viewpoint may lie off the base's origin.
RANGES_M: Final = (0.3, 0.6, 1.2, 2.5, 5.0, math.inf)
SAMPLES: Final = 13  # across a tile of 6 degrees, so that each sector has two


class Unwatched:
    """Maps columns of tiles to sectors about the base, and to directions from the viewpoint."""

    def __init__(self, cylinder: Cylinder, T_base_rect: Array) -> None:
        """T_base_rect (4, 4): from the rectified frame to the base."""
        count = tile_columns(cylinder)
        columns = (np.arange(count)[:, None] + np.linspace(0.0, 1.0, SAMPLES)) * (cylinder.width / count) - 0.5
        pixels = np.column_stack([columns.ravel(), np.full(columns.size, cylinder.row0)])
        direction = (cylinder.rays(pixels) @ T_base_rect[:3, :3].T)[:, :2]
        self._sectors = np.empty((len(RANGES_M), count, SAMPLES), np.intp)
        for range_m, sectors in zip(RANGES_M, self._sectors, strict=True):
            x, y = (direction + T_base_rect[:2, 3] / range_m).T
            turned = (np.arctan2(y, x) + math.pi) * (SECTORS / math.tau)
            sectors[:] = (np.floor(turned).astype(np.intp) % SECTORS).reshape(sectors.shape)

    def sectors(self, columns: Flags) -> Flags:
        """Return the sectors (SECTORS,) of columns of tiles (C,); where all tiles live, C is that of a full turn."""
        return self._marked(self._sectors[:, np.flatnonzero(columns)])

    def directions(self, columns: Flags) -> Flags:
        """Return the directions (SECTORS,) from the viewpoint, about axes parallel to the base's, of columns (C,)."""
        return self._marked(self._sectors[-1, np.flatnonzero(columns)])

    @staticmethod
    def _marked(sectors: NDArray[np.intp]) -> Flags:
        found = np.zeros(SECTORS, bool)
        found[sectors] = True
        return found
