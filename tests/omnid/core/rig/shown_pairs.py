"""Pairs of panoramas of a rendered corridor, as the check of the rig is shown them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from omnid.core.odometry.stereo_frame import StereoFrame
from omnid.core.types.panorama import PaddedPanorama
from omnid.core.types.pixel_times import AT_ONCE, PixelTimes
from tests.omnid.core.scenery import turned, wrapped


@dataclass(frozen=True, slots=True)
class ShownPair:
    """A pair with its stamp [ns]."""

    stamp_ns: int
    lower: PaddedPanorama
    upper: PaddedPanorama
    visible: NDArray[np.bool_]
    times: PixelTimes = AT_ONCE

    @staticmethod
    def of(frame: StereoFrame, stamp_ns: int = 0, upper_turn_px: float = 0.0) -> ShownPair:
        """Return a frame as a pair whose upper camera is turned by columns."""
        upper = frame.upper if not upper_turn_px else wrapped(turned(frame.upper.panorama, upper_turn_px))
        return ShownPair(stamp_ns, frame.lower, upper, frame.usable)

    @property
    def exchanged(self) -> ShownPair:
        """The pair with its cameras exchanged."""
        return ShownPair(self.stamp_ns, self.upper, self.lower, self.visible)

    @property
    def dark(self) -> ShownPair:
        """The pair with the light off."""
        black = wrapped(np.zeros_like(self.lower.panorama))
        return ShownPair(self.stamp_ns, black, black, self.visible)
