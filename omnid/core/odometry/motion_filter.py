"""Kalman filter of the motion: velocity and acceleration, six of each (Dang et al. 2012, eq. (10), (11))."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from calib import se3
from omnid.core.kalman_filter import kalman_filter

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
        self._filter = kalman_filter(dim_x=12, dim_z=6)
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

    def after(self, T_prev_curr: Array, covariance: Array, dt_s: float) -> tuple[Array, Array]:
        """Return the `motion` after an update with a measurement; the filter itself is not updated."""
        kept = self._filter.x.copy(), self._filter.P.copy()
        self.update(T_prev_curr, covariance, dt_s)
        found = self.motion(dt_s)
        self._filter.x, self._filter.P = kept
        return found

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
