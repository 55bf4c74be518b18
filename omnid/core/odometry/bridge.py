"""Bridge over frames that show nothing: the pose is continued by wheels and gyro, for a limited time."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from omnid.core.odometry.limits import OdometryLimits
from omnid.core.odometry.sensed_motion import SensedMotion

Array = NDArray[np.float64]


class Bridge:
    """The error that has grown since the cameras gave the last pose.

    Errors of scale and bias are the same in all steps: their standard deviations add up, and not their variances.
    """

    def __init__(self, limits: OdometryLimits) -> None:
        self._limits = limits
        self.end()

    def end(self) -> None:
        """Begin again from a pose of the cameras."""
        self._time_s = 0.0
        self._systematic = np.zeros(6)  # sum of the standard deviations
        self._variance_m2 = 0.0  # of the position

    def carries(self, sensed: SensedMotion, dt_s: float) -> bool:
        """True if the pose may go on by a sensed step of dt_s, within the limits of time and uncertainty."""
        limits = self._limits
        return (
            sensed.is_complete
            and self._time_s + dt_s <= limits.bridge_s
            and self._variance_m2 + self._largest_m2(self._growth(sensed)) <= limits.bridge_sigma_m**2
        )

    def step(self, sensed: SensedMotion, dt_s: float) -> Array:
        """Take a step; return the covariance (6, 6) that it adds to the pose, in the axes of the frame."""
        growth = self._growth(sensed)
        self._time_s += dt_s
        self._systematic += np.sqrt(np.diag(sensed.systematic))
        self._variance_m2 += self._largest_m2(growth)
        return growth

    def _growth(self, sensed: SensedMotion) -> Array:
        sigma = np.sqrt(np.diag(sensed.systematic))
        return sensed.noise + sensed.systematic + np.diag(2 * self._systematic * sigma)

    @staticmethod
    def _largest_m2(growth: Array) -> float:
        return float(np.diag(growth)[:3].max())
