"""Whether the mirror's rim is still where a mask has it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from calib.masks.rim import find_rim
from calib.models.camera import Mask

# A mask may reach so far beyond the rim that is found: a pixel or two is how well it can be, a bit more as masks are
# drawn by hand as well.
MAX_BEYOND_PX, MAX_BEYOND_PART = 3.0, 0.005


@dataclass(frozen=True, slots=True)
class RimShift:
    """Where the rim is, by what its centre has moved (u, v) from the mask's, how much wider it is, all in pixels."""

    rim: Mask
    moved_px: tuple[float, float]
    wider_px: float

    @property
    def beyond_px(self) -> float:
        """How far the mask reaches beyond the rim, where most."""
        return float(np.hypot(*self.moved_px)) - self.wider_px

    @property
    def fits(self) -> bool:
        """Whether the mask shows nothing but the mirror."""
        return self.beyond_px <= MAX_BEYOND_PX + MAX_BEYOND_PART * self.rim.outer_px


def rim_shift(brightest: NDArray[np.uint8], mask: Mask | None) -> RimShift | None:
    """The rim in the maximum of several images (H, W), against a mask; None where either is not known."""
    if mask is None or not np.isfinite(mask.outer_px):
        return None
    rim = find_rim(brightest, mask.center)
    if rim is None:
        return None
    moved = (rim.center[0] - mask.center[0], rim.center[1] - mask.center[1])
    return RimShift(rim, moved, rim.outer_px - mask.outer_px)
