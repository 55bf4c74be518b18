"""Times at which the pixels of a pair of panoramas were exposed."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Final

import numpy as np
from numpy.typing import NDArray

from calib.panorama import at_pixels

Array = NDArray[np.float64]


def _no_rows() -> NDArray[np.float32]:
    return np.zeros((0, 0), np.float32)


@dataclass(frozen=True, slots=True, eq=False)
class PixelTimes:
    """Times of exposure of a pair's panorama pixels, s after the stamp of the pair."""

    skew_s: float = 0.0  # time of the upper image's first row relative to the lower one's
    # (H, W) of each pixel after the first image row; (0, 0): all at one time
    lower_rows_s: NDArray[np.float32] = field(default_factory=_no_rows)
    upper_rows_s: NDArray[np.float32] = field(default_factory=_no_rows)

    @property
    def is_synchronised(self) -> bool:
        """True if all pixels are exposed at the stamp."""
        return self.skew_s == 0 and self.lower_rows_s.size == 0 and self.upper_rows_s.size == 0

    def lower(self, pixels: Array) -> Array:
        """Return the times (N,) of pixels (N, 2) of the lower panorama."""
        return _read(self.lower_rows_s, pixels)

    def upper(self, pixels: Array) -> Array:
        """Return the times (N,) of pixels (N, 2) of the upper panorama."""
        return self.skew_s + _read(self.upper_rows_s, pixels)


SYNCHRONISED: Final = PixelTimes()


def _read(table: NDArray[np.float32], pixels: Array) -> Array:
    """Return the values (N,) of a table (H, W) at the nearest of pixels (N, 2); zeros from an empty table."""
    return np.asarray(at_pixels(table, pixels), float) if table.size else np.zeros(len(pixels))
