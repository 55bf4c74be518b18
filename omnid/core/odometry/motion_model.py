"""Motion from frame to frame: predicted by the filter, corrected and bridged by wheels and gyro."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from calib import se3
from omnid.core.odometry.estimates import OdometryLimits
from omnid.core.odometry.exposure_times import RigVelocity
from omnid.core.odometry.motion_filter import START_ACCELERATION_VARIANCE, MotionFilter, SensedMotion

Array = NDArray[np.float64]

# Rotation by which two steps of a robot do not differ, because 4 rad/s^2, the most that controller.limits allows by
# default, make 0.04 rad in steps of 0.1 s.
SUDDEN_RAD = 0.14
SLOWING_S = 0.3  # time constant of the predicted velocity's decay while poses are refused.


class MotionModel:
    """The velocity of the rectified frame, and its next step. Steps are T_prev_curr (4, 4)."""

    def __init__(self, limits: OdometryLimits, motion_filter: MotionFilter | None = None) -> None:
        """motion_filter: None for a new one."""
        self._limits = limits
        self._filter = motion_filter or MotionFilter()
        self._last_step: tuple[Array, float] | None = None  # T_prev_curr that was accepted last, and its time
        self.found()

    @property
    def velocity(self) -> Array:
        """Velocity (6,) [m/s; rad/s]."""
        return self._filter.velocity

    @property
    def velocity_covariance(self) -> Array:
        """Covariance (6, 6) of the velocity."""
        return self._filter.velocity_covariance

    def predict(self, sensed: SensedMotion | None, dt_s: float) -> Array:
        """Return the step to a frame dt_s later: v <- v + dt a, T_prev_curr = exp(v dt) (Dang et al. 2012, eq. 10).

        What wheels and gyro say is a measurement of the filter; they also know what happened in a long gap.
        """
        T_prev_curr = self._filter.predict(min(dt_s, self._limits.max_gap_s))
        if sensed is not None and dt_s > 0:
            T_prev_curr = self._filter.update(sensed.T_prev_curr, sensed.covariance, dt_s)
        return T_prev_curr

    def at_exposure(self, dt_s: float = 0.0) -> RigVelocity:
        """Return the velocity at the last frame, or at the one to which a step of dt_s was predicted."""
        return RigVelocity(*self._filter.motion(dt_s))

    def accept(
        self, T_prev_curr: Array, covariance: Array, dt_s: float, *, exposed_at_once: bool
    ) -> RigVelocity | None:
        """Update the filter with the step that the cameras found (eq. 11), with its covariance (6, 6).

        Returns the velocity at the pair before the step, from the steps around it. A velocity that changes evenly is
        exact there; how far it changes unevenly in a step, no step shows. A sudden turn shows no velocity during the
        exposures: where it matters, the filter begins from standstill.
        """
        turned = se3.log(T_prev_curr)[3:] - self.velocity[3:] * dt_s
        if not exposed_at_once and np.linalg.norm(turned) > SUDDEN_RAD:
            self.reset()
            return None
        self._filter.update(T_prev_curr, covariance, dt_s)
        now, before, self._last_step = self.of_step(T_prev_curr, dt_s), self._last_step, (T_prev_curr, dt_s)
        if before is None:
            return now
        before_rate, before_s = se3.log(before[0]) / before[1], before[1]
        at_previous = (before_s * now.twist + dt_s * before_rate) / (before_s + dt_s)
        uneven = np.diag(((now.twist - before_rate) / 2) ** 2)
        return RigVelocity(at_previous, covariance / (2 * dt_s**2) + uneven)

    @staticmethod
    def of_step(T_prev_curr: Array, dt_s: float) -> RigVelocity:
        """Return the velocity at either end of a single step, which changes by an acceleration that is not known."""
        return RigVelocity(se3.log(T_prev_curr) / dt_s, START_ACCELERATION_VARIANCE * (dt_s / 2) ** 2 * np.eye(6))

    def found(self) -> None:
        """Note that the cameras have found a pose: nothing is to be bridged, and no error has grown."""
        self._bridged_s = 0.0
        self._systematic = np.zeros(6)  # sum of the standard deviations of the steps since then
        self._variance_m2 = 0.0  # variance of the position

    def carry(self, sensed: SensedMotion | None, dt_s: float) -> Array | None:
        """Return the covariance (6, 6) of a step that nothing was seen in, by wheels and gyro; None where they end.

        They end at the limits of time and uncertainty; then the velocity decays. Errors of scale and bias are the same
        in all steps: their standard deviations add up, and not their variances.
        """
        self._last_step = None
        if sensed is not None and sensed.is_complete:
            sigma = np.sqrt(np.diag(sensed.systematic))
            growth = sensed.noise + sensed.systematic + np.diag(2 * self._systematic * sigma)
            variance_m2 = self._variance_m2 + float(np.diag(growth)[:3].max())
            if self._bridged_s + dt_s <= self._limits.bridge_s and variance_m2 <= self._limits.bridge_sigma_m**2:
                self._bridged_s, self._variance_m2 = self._bridged_s + dt_s, variance_m2
                self._systematic += sigma
                return growth
        self._filter.slow_down(math.exp(-dt_s / SLOWING_S))
        return None

    def reset(self) -> None:
        """Begin from standstill."""
        self._filter.reset()
        self._last_step = None
