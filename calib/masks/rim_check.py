"""Comparison of the mirror's rim in images with the rim of a mask."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from calib.masks.rim import find_rim
from calib.models.camera import Mask

# Tolerance for a mask that reaches beyond the rim, because a rim is found to a pixel or two, and masks are also drawn
# by hand.
MAX_BEYOND_PX, MAX_BEYOND_PART = 3.0, 0.005


@dataclass(frozen=True, slots=True)
class RimShift:
    """The rim found in images, relative to a mask: shift (u, v) of its centre and difference of radii [px]."""

    rim: Mask
    moved_px: tuple[float, float]
    wider_px: float

    @property
    def beyond_px(self) -> float:
        """Return the largest distance [px] by which the mask reaches beyond the rim."""
        return float(np.hypot(*self.moved_px)) - self.wider_px

    @property
    def fits(self) -> bool:
        """True if the mask contains only the mirror, within the tolerance."""
        return self.beyond_px <= MAX_BEYOND_PX + MAX_BEYOND_PART * self.rim.outer_px


def rim_shift(brightest: NDArray[np.uint8], mask: Mask | None) -> RimShift | None:
    """Compare the rim in the maximum of several images (H, W) with a mask; None if either is not known."""
    if mask is None or not np.isfinite(mask.outer_px):
        return None
    rim = find_rim(brightest, mask.center)
    if rim is None:
        return None
    moved = (rim.center[0] - mask.center[0], rim.center[1] - mask.center[1])
    return RimShift(rim, moved, rim.outer_px - mask.outer_px)
