"""Velocity of the rig during the exposures of a pair, before the pair itself is measured.

A vehicle drives and turns smoothly, which the motion filter extrapolates. It also vibrates: heave, roll and pitch
change from pair to pair, and an extrapolation of them is worse than their mean. Which component is which depends on the
vehicle and the floor. So both are predicted, the next pair shows how well each did, and of each component the better
prediction is taken. The errors of the mean are its standard deviation.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from calib import se3
from omnid.core.odometry.exposure_times import RigVelocity
from omnid.core.odometry.motion_filter import START_VELOCITY_VARIANCE, MotionFilter

Array = NDArray[np.float64]

# Steps over which means are taken, and no time, because their noise falls with their number.
MEMORY = 12.0
MIN_STEPS = 4  # With fewer steps the filter's covariance is used, because their scatter is not known.
LEAST_SIGMA = np.repeat([1e-3, 1e-3], 3)  # m/s, rad/s: of the mean.

# After a start or a sudden turn, because nothing else is known then: the variance of the filter's own start.
UNKNOWN_VELOCITY = RigVelocity(np.zeros(6), START_VELOCITY_VARIANCE * np.eye(6))


class ExposureVelocity:
    """Prediction of the velocity at the stamp of each pair, in the rectified frame."""

    def __init__(self, motion_filter: MotionFilter) -> None:
        self._filter = motion_filter
        self.reset()

    def reset(self) -> None:
        """Forget the means and errors, as after a break."""
        self._steps = 0
        self._mean, self._mean_squared, self._filter_squared = np.zeros(6), np.zeros(6), np.zeros(6)
        # Rate of the last step and its time, and what filter and mean predicted then.
        self._previous: tuple[Array, float, Array, Array] | None = None

    def predicted(self, dt_s: float) -> RigVelocity:
        """Return the velocity dt_s after the last pair, whose step the filter has just predicted."""
        return self._chosen(*self._filter.motion(dt_s), self._mean)

    def after(self, T_prev_curr: Array, covariance: Array, dt_s: float) -> RigVelocity:
        """Return the velocity at a pair with that step from the previous one and its covariance (6, 6)."""
        mean = self._with(se3.log(T_prev_curr) / dt_s)
        return self._chosen(*self._filter.after(T_prev_curr, covariance, dt_s), mean)

    def accept(self, T_prev_curr: Array, covariance: Array, dt_s: float) -> RigVelocity | None:
        """Take note of the step that the filter was updated with, and of its covariance (6, 6).

        Returns the velocity at the pair before, which is between this step and the one before it; None after a break.
        """
        rate, found = se3.log(T_prev_curr) / dt_s, None
        if self._previous is not None:
            before, before_s, of_filter, of_mean = self._previous
            at_previous = (before_s * rate + dt_s * before) / (before_s + dt_s)
            # A velocity that changes evenly is exact there; how far it changes unevenly in a step, no step shows.
            uneven = np.diag(((rate - before) / 2) ** 2 + LEAST_SIGMA**2)
            found = RigVelocity(at_previous, covariance / (2 * dt_s**2) + uneven)
            self._steps += 1
            gain = max(1 / MEMORY, 1 / self._steps)
            self._filter_squared += gain * ((at_previous - of_filter) ** 2 - self._filter_squared)
            self._mean_squared += gain * ((at_previous - of_mean) ** 2 - self._mean_squared)
        self._mean = self._with(rate)
        self._previous = rate, dt_s, self._filter.motion(dt_s)[0], self._mean
        return found

    def _with(self, rate: Array) -> Array:
        """Return the mean with one more step."""
        if self._previous is None:
            return rate
        return self._mean + max(1 / MEMORY, 1 / (self._steps + 2)) * (rate - self._mean)

    def _chosen(self, of_filter: Array, covariance: Array, mean: Array) -> RigVelocity:
        """Return the better prediction of each component."""
        steady = (self._mean_squared < self._filter_squared) & (self._steps >= MIN_STEPS)
        chosen = np.where(steady, mean, of_filter)
        both = np.where(steady[:, None] | steady, 0.0, covariance)
        return RigVelocity(chosen, both + np.diag(np.where(steady, self._mean_squared + LEAST_SIGMA**2, 0.0)))
