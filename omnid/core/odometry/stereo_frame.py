"""Input of the odometry at one instant, and its features as shown by viewers."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from omnid.core.odometry.exposure_times import Exposure
from omnid.core.types.panorama import PaddedPanorama
from omnid.core.types.pixel_times import SYNCHRONISED, PixelTimes


@dataclass(frozen=True, slots=True)
class StereoFrame:
    """Both panoramas, and the disparity image of the lower one, which may be computed when it is first read."""

    seq: int
    lower: PaddedPanorama
    upper: PaddedPanorama
    # The image, or the function that returns it for a motion during the exposures; None: unknown, or synchronised.
    disparities: NDArray[np.float32] | Callable[[Exposure | None], NDArray[np.float32]]
    usable: NDArray[np.bool_]  # (H, W) pixels that show the world in both panoramas
    times: PixelTimes = SYNCHRONISED
    interval_s: tuple[float, float] | None = None  # since the frame before, by the clock of the motion sensors
    # The motion for which disparities are corrected; None: not known, so that they are as seen.
    exposure: Exposure | None = None
    lost: NDArray[np.bool_] | None = None  # (H, W) pixels in parts that are dead or blind; None: there are none

    @property
    def disparity(self) -> NDArray[np.float32]:
        """Disparities (H, W) [px] of the lower panorama's pixels at the stamp, NaN: unknown."""
        return self.disparities(self.exposure) if callable(self.disparities) else self.disparities


@dataclass(frozen=True, slots=True, eq=False)
class Features:
    """Pixels (N, 2) = (column, row) in the lower panorama of the features of a frame, for display."""

    inliers: NDArray[np.float64] = field(default_factory=lambda: np.zeros((0, 2)))  # landmarks that support the pose
    rejected: NDArray[np.float64] = field(default_factory=lambda: np.zeros((0, 2)))  # tracked landmarks, no inliers
