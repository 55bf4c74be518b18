"""Image of a panorama that wraps around."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Image = NDArray[np.uint8]


@dataclass(frozen=True, slots=True)
class PaddedPanorama:
    """Panorama whose first and last pad_px columns are repeated, so that windows run across the seam."""

    image: Image  # (H, W + 2 pad) uint8
    pad_px: int
    noise_grey: float = 1.0  # standard deviation of the noise, grey levels
    gain: float = 1.0  # by which the image was multiplied because it was dim

    @property
    def width(self) -> int:
        """Columns of one full turn [px]."""
        return int(self.image.shape[1]) - 2 * self.pad_px

    @property
    def panorama(self) -> Image:
        """The panorama itself (H, W), a view."""
        return self.image[:, self.pad_px : self.pad_px + self.width]
