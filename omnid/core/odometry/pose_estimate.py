"""A pose and what speaks for it."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class PoseEstimate:
    """A pose T_odom_rect, its covariance, and how many landmarks were tried, tracked and agree.

    The covariance takes the landmarks of the local map as they are; without any (known by a keyframe), it is whole.
    """

    T_odom_rect: Array
    covariance: Array  # (6, 6) [t; r] in the rectified frame
    visible: int
    tracked: int
    inliers: int
    landmarks: NDArray[np.intp] = field(default_factory=lambda: np.zeros(0, np.intp))  # (M,) of the local map
    pixels: Array = field(default_factory=lambda: np.zeros((0, 2)))  # (M, 2) where they are seen
    rejected: Array = field(default_factory=lambda: np.zeros((0, 2)))  # (K, 2) where others were tracked to

    @property
    def share(self) -> float:
        """Agreeing landmarks among those tracked."""
        return self.inliers / max(1, self.tracked)
