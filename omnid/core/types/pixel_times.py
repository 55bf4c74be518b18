"""Times at which the pixels of a pair of panoramas were exposed."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from calib.panorama import at_pixels

Array = NDArray[np.float64]
Rows = NDArray[np.float32]


@dataclass(frozen=True, slots=True, eq=False)
class PixelTimes:
    """Times of exposure of a pair's panorama pixels, s after the stamp of the pair."""

    skew_s: float = 0.0  # time of the upper image's first row relative to the lower one's
    # (H, W) of each pixel after the first image row; None: all at one time
    lower_rows_s: Rows | None = None
    upper_rows_s: Rows | None = None

    @property
    def is_synchronised(self) -> bool:
        """True if all pixels are exposed at the stamp."""
        return self.skew_s == 0 and self.lower_rows_s is None and self.upper_rows_s is None

    def lower(self, pixels: Array) -> Array:
        """Return the times (N,) of pixels (N, 2) of the lower panorama."""
        return _read(self.lower_rows_s, pixels)

    def upper(self, pixels: Array) -> Array:
        """Return the times (N,) of pixels (N, 2) of the upper panorama."""
        return self.skew_s + _read(self.upper_rows_s, pixels)


SYNCHRONISED: Final = PixelTimes()


def _read(table: Rows | None, pixels: Array) -> Array:
    """Return the values (N,) of a table (H, W) at the nearest of pixels (N, 2); zeros without one."""
    return np.zeros(len(pixels)) if table is None else np.asarray(at_pixels(table, pixels), float)
