"""What the ego-motion sees at one instant."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from omnid.core.odometry.tracking import PaddedPanorama


@dataclass(frozen=True, slots=True)
class StereoFrame:
    """Both panoramas, the disparity image (H, W) float32 [px] of the lower one (NaN unknown), and what is the world."""

    seq: int
    lower: PaddedPanorama
    upper: PaddedPanorama
    disparity: NDArray[np.float32]
    usable: NDArray[np.bool_]  # (H, W)


def _nowhere() -> NDArray[np.float64]:
    return np.zeros((0, 2))


@dataclass(frozen=True, slots=True, eq=False)
class Features:
    """What became of the features of a sight: pixels (N, 2) column, row in the lower panorama, to be looked at."""

    inliers: NDArray[np.float64] = field(default_factory=_nowhere)  # landmarks that the pose rests on
    rejected: NDArray[np.float64] = field(default_factory=_nowhere)  # found, but where the pose does not have them
    new: NDArray[np.float64] = field(default_factory=_nowhere)  # landmarks from now on
