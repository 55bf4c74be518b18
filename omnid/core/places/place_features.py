"""Features of a place."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

DESCRIPTOR: Final = 128  # Bytes of a descriptor; exact: 8 directions in 4 x 4 cells.


@dataclass(frozen=True, slots=True, eq=False)
class PlaceFeatures:
    """Features of a lower panorama whose depth is known: descriptors (N, 128), views (N, 3) [px].

    A view is column, lower row, upper row.
    """

    descriptors: NDArray[np.uint8]
    views: NDArray[np.float32]

    @property
    def nbytes(self) -> int:
        """Memory that the features take."""
        return self.descriptors.nbytes + self.views.nbytes

    def first(self, count: int) -> PlaceFeatures:
        """Return the first of the features: the strongest ones, which are evenly spread."""
        return PlaceFeatures(self.descriptors[:count], self.views[:count])


# Features of a frame that shows none; exact.
NOTHING: Final = PlaceFeatures(np.zeros((0, DESCRIPTOR), np.uint8), np.zeros((0, 3), np.float32))
