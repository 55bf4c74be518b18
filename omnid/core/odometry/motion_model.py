"""Motion from frame to frame: predicted by the filter, corrected and bridged by wheels and gyro."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from calib import se3
from omnid.core.odometry.estimates import OdometryLimits
from omnid.core.odometry.exposure_times import ExposureVelocity, RigVelocity
from omnid.core.odometry.motion_filter import MotionFilter, SensedMotion

Array = NDArray[np.float64]

SLOWING_S = 0.3  # time constant of the predicted velocity's decay while poses are refused.
# Rotation by which two steps of a robot do not differ, because 4 rad/s^2, the most that controller.limits allows by
# default, make 0.04 rad in steps of 0.1 s.
SUDDEN_RAD = 0.14


class MotionModel:
    """The velocity of the rectified frame, and its next step. Steps are T_prev_curr (4, 4)."""

    def __init__(self, limits: OdometryLimits, motion_filter: MotionFilter | None = None) -> None:
        """motion_filter: None for a new one."""
        self._longest_s = limits.max_gap_s
        self._filter = motion_filter or MotionFilter()
        self._exposures = ExposureVelocity(self._filter)
        self._bridge = Bridge(limits)

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
        T_prev_curr = self._filter.predict(min(dt_s, self._longest_s))
        if sensed is not None and dt_s > 0:
            T_prev_curr = self._filter.update(sensed.T_prev_curr, sensed.covariance, dt_s)
        return T_prev_curr

    def now(self) -> RigVelocity:
        """Return the velocity at the last frame."""
        return RigVelocity(*self._filter.motion(0.0))

    def at_exposure(self, dt_s: float) -> RigVelocity:
        """Return the velocity at the frame to which a step of dt_s was predicted, before it is seen."""
        return self._exposures.predicted(dt_s)

    def after(self, T_prev_curr: Array, covariance: Array, dt_s: float) -> RigVelocity:
        """Return the velocity at the end of a step with its covariance (6, 6)."""
        return self._exposures.after(T_prev_curr, covariance, dt_s)

    def accept(
        self, T_prev_curr: Array, covariance: Array, dt_s: float, *, exposed_at_once: bool
    ) -> RigVelocity | None:
        """Update the filter with the step that the cameras found (eq. 11); after a sudden one begin from standstill.

        Returns the velocity at the pair before the step, where the steps around it determine it.
        """
        is_sudden = not exposed_at_once and self.is_sudden(T_prev_curr, dt_s)
        self._filter.update(T_prev_curr, covariance, dt_s)
        at_previous = self._exposures.accept(T_prev_curr, covariance, dt_s)
        if is_sudden:
            self.reset()
        return None if is_sudden else at_previous

    def found(self) -> None:
        """Note that the cameras have found a pose: nothing is to be bridged."""
        self._bridge.end()

    def carry(self, sensed: SensedMotion | None, dt_s: float) -> Array | None:
        """Return the covariance (6, 6) of a step that nothing was seen in, by wheels and gyro; None where they end.

        Then the velocity decays.
        """
        if sensed is not None and self._bridge.carries(sensed, dt_s):
            return self._bridge.step(sensed, dt_s)
        self._filter.slow_down(math.exp(-dt_s / SLOWING_S))
        return None

    def reset(self) -> None:
        """Begin from standstill."""
        self._filter.reset()
        self._exposures.reset()

    def is_sudden(self, T_prev_curr: Array, dt_s: float) -> bool:
        """True if a motion differs too much from the predicted one to give the velocity during the exposures."""
        change = se3.log(T_prev_curr) - self._filter.velocity * dt_s
        return bool(np.linalg.norm(change[3:]) > SUDDEN_RAD)


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
        self._variance_m2 = 0.0  # variance of the position

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
