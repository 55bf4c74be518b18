"""Kalman filter of the motion: velocity and acceleration, six of each (Dang et al. 2012, eq. (10), (11)).

Below it: motion from frame to frame, predicted by the filter, corrected and bridged by wheels and gyro.
"""

from __future__ import annotations

import math

import numpy as np
from filterpy.kalman import KalmanFilter
from numpy.typing import NDArray

from calib import se3
from omnid.core.odometry.estimates import OdometryLimits
from omnid.core.odometry.exposure_times import RigVelocity
from omnid.core.odometry.motion_sensors import SensedMotion

Array = NDArray[np.float64]

# Spectral density of the jerk for translation and rotation, (m/s^3)^2/Hz and (rad/s^3)^2/Hz, of a wheeled robot.
# Measured: with 0.67 and 1.5 times as much the odometry errs 0.98 to 1.01 times as much, but for one log at 1152 px
JERK_PSD = (10.0, 40.0)
START_VELOCITY_VARIANCE = 1.0  # (m/s)^2 and (rad/s)^2 of a motion that is not known yet.
START_ACCELERATION_VARIANCE = 4.0  # (m/s^2)^2 and (rad/s^2)^2.
MIN_VELOCITY_VARIANCE = 1e-10  # added to each measurement, so that its covariance can be inverted


class MotionFilter:
    """Filter of twists [m/s; rad/s] in the rig frame; state (v, a), v <- v + dt a, measured v = (t, r) / dt.

    jerk_psd: spectral density of the jerk, for translation and rotation [(m/s^3)^2/Hz, (rad/s^3)^2/Hz].
    """

    def __init__(self, jerk_psd: tuple[float, float] = JERK_PSD) -> None:
        self._filter = KalmanFilter(dim_x=12, dim_z=6)
        self._filter.H = np.hstack([np.eye(6), np.zeros((6, 6))])
        self._psd = np.repeat(jerk_psd, 3)
        self.reset()

    def reset(self) -> None:
        """Reset to standstill, with the uncertainty of what a robot can do."""
        self._filter.x = np.zeros((12, 1))
        self._filter.P = np.diag(np.repeat([START_VELOCITY_VARIANCE, START_ACCELERATION_VARIANCE], 6))

    @property
    def velocity(self) -> Array:
        """Velocity (6,) [m/s; rad/s]."""
        return np.array(self._filter.x[:6, 0])

    @property
    def velocity_covariance(self) -> Array:
        """Covariance (6, 6) of the velocity."""
        P = self._filter.P[:6, :6]
        return np.asarray((P + P.T) / 2)

    def motion(self, dt_s: float) -> tuple[Array, Array]:
        """Return the velocity (6,) at the end of the last step of dt_s, and its covariance (6, 6).

        The state holds the mean velocity of the step: at its end, half a step later, it is v + dt/2 a.
        """
        F = np.hstack([np.eye(6), dt_s / 2 * np.eye(6)])
        P = F @ self._filter.P @ F.T
        return F @ self._filter.x[:, 0], np.asarray((P + P.T) / 2)

    def predict(self, dt_s: float) -> Array:
        """Predict the state dt_s later and return the expected motion T_prev_curr (4, 4)."""
        F, Q, velocity, acceleration = np.eye(12), np.zeros((12, 12)), np.arange(6), np.arange(6, 12)
        F[velocity, acceleration] = dt_s
        Q[velocity, velocity] = self._psd * dt_s**3 / 3
        Q[velocity, acceleration] = Q[acceleration, velocity] = self._psd * dt_s**2 / 2
        Q[acceleration, acceleration] = self._psd * dt_s
        self._filter.predict(F=F, Q=Q)
        return se3.exp(self.velocity * dt_s)

    def update(self, T_prev_curr: Array, covariance: Array, dt_s: float) -> Array:
        """Update with a measured motion and its covariance (6, 6); return the filtered motion T_prev_curr (4, 4)."""
        # 1. The measured velocity is the motion over its time.
        R = covariance / dt_s**2 + MIN_VELOCITY_VARIANCE * np.eye(6)
        self._filter.update(se3.log(T_prev_curr)[:, None] / dt_s, R=R)
        # 2. Rounding must not make the covariance unsymmetric.
        self._filter.P = (self._filter.P + self._filter.P.T) / 2
        # 3. The filtered velocity gives the motion.
        return se3.exp(self.velocity * dt_s)

    def slow_down(self, factor: float) -> None:
        """Multiply velocity and acceleration by a factor below 1, while no motion is measured."""
        self._filter.x *= factor


# Rotation by which two steps of a robot do not differ, because 4 rad/s^2, the most that controller.limits allows by
# default, make 0.04 rad in steps of 0.1 s.
SUDDEN_RAD = 0.14
SLOWING_S = 0.3  # time constant of the predicted velocity's decay while poses are refused.


class MotionModel(MotionFilter):
    """The velocity of the rectified frame, and its next step. Steps are T_prev_curr (4, 4)."""

    _last_step: tuple[Array, float] | None  # T_prev_curr that was accepted last, and its time

    def __init__(self, limits: OdometryLimits) -> None:
        super().__init__()
        self._limits = limits
        self.found()

    def step(self, sensed: SensedMotion | None, dt_s: float) -> Array:
        """Return the step to a frame dt_s later: v <- v + dt a, T_prev_curr = exp(v dt) (Dang et al. 2012, eq. 10).

        What wheels and gyro say is a measurement of the filter; they also know what happened in a long gap.
        """
        T_prev_curr = self.predict(min(dt_s, self._limits.max_gap_s))
        if sensed is not None and dt_s > 0:
            T_prev_curr = self.update(sensed.T_prev_curr, sensed.covariance, dt_s)
        return T_prev_curr

    def at_exposure(self, dt_s: float = 0.0) -> RigVelocity:
        """Return the velocity at the last frame, or at the one to which a step of dt_s was predicted."""
        return RigVelocity(*self.motion(dt_s))

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
        self.update(T_prev_curr, covariance, dt_s)
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
        self.slow_down(math.exp(-dt_s / SLOWING_S))
        return None

    def reset(self) -> None:
        """Begin from standstill."""
        super().reset()
        self._last_step = None
