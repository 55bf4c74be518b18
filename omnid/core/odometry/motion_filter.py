"""The Kalman filter of the motion: velocity and acceleration, six of each (Dang et al. 2012, eq. (10), (11))."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from calib import se3

Array = NDArray[np.float64]


class MotionFilter:
    """Filters twists [m/s; rad/s] in the rig frame; state (v, a), v <- v + dt a, measured v = (t, r) / dt.

    jerk_psd: spectral density of the jerk, for translation and rotation [(m/s^3)^2/Hz, (rad/s^3)^2/Hz].
    """

    def __init__(self, jerk_psd: tuple[float, float] = (10.0, 40.0)) -> None:
        from filterpy.kalman import KalmanFilter  # a second of imports, and only odometry needs it

        self._filter: Any = KalmanFilter(dim_x=12, dim_z=6)
        self._filter.H = np.hstack([np.eye(6), np.zeros((6, 6))])
        self._psd = np.repeat(jerk_psd, 3)
        self.reset()

    def reset(self) -> None:
        """Forgets the motion: standing still, within what a robot can do."""
        self._filter.x = np.zeros((12, 1))
        self._filter.P = np.diag(np.repeat([1.0, 4.0], 6))

    @property
    def velocity(self) -> Array:
        """Velocity (6,) [m/s, rad/s]."""
        return np.array(self._filter.x[:6, 0])

    @property
    def velocity_covariance(self) -> Array:
        """Covariance (6, 6) of the velocity."""
        P = self._filter.P[:6, :6]
        return np.asarray((P + P.T) / 2)

    def predict(self, dt_s: float) -> Array:
        """Moves the state on by dt and returns the motion T_prev_curr (4, 4) to expect."""
        F = np.eye(12)
        F[:6, 6:] = dt_s * np.eye(6)
        noise = np.diag(self._psd)
        Q = np.block([[noise * dt_s**3 / 3, noise * dt_s**2 / 2], [noise * dt_s**2 / 2, noise * dt_s]])
        self._filter.predict(F=F, Q=Q)
        return se3.exp(self.velocity * dt_s)

    def update(self, T_prev_curr: Array, covariance: Array, dt_s: float) -> Array:
        """Takes a measured motion with its covariance (6, 6) and returns the filtered one, T_prev_curr (4, 4)."""
        self._filter.update(se3.log(T_prev_curr)[:, None] / dt_s, R=covariance / dt_s**2 + 1e-10 * np.eye(6))
        self._filter.P = (self._filter.P + self._filter.P.T) / 2
        return se3.exp(self.velocity * dt_s)

    def slow_down(self, factor: float) -> None:
        """Believes less in the last motion: what a robot does when nobody watches."""
        self._filter.x *= factor
