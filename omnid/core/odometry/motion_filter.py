"""Kalman filter of the motion: velocity and acceleration, six of each (Dang et al. 2012, eq. (10), (11)).

Below it: the motion that wheels and gyro measure between two stamps.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from filterpy.kalman import KalmanFilter
from numpy.typing import NDArray

from calib import se3

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


LONGEST_GAP_S = 0.15  # Longest gap between samples, and before the end of an interval.
MOST_SAMPLES = 512  # Samples that are kept, so that memory is bounded: two seconds of a sensor of 250 Hz.


class RateIntegral(NamedTuple):
    """Integral (size,) of the rates of a sensor over an interval, and their change (size,) from start to end."""

    amounts: Array
    changes: Array


class RateHistory:
    """The newest samples of one sensor: times [s] and rates, in the order of the times."""

    def __init__(self, size: int) -> None:
        """size: numbers of a sample."""
        self._times, self._rates = np.zeros(0), np.zeros((0, size))

    def add(self, times_s: Array, rates: Array) -> None:
        """Add samples at times (N,) with rates (N, size); one at a known time replaces the other."""
        times, first = np.unique(np.concatenate([times_s, self._times]), return_index=True)
        rates = np.concatenate([rates, self._rates])[first]
        self._times, self._rates = times[-MOST_SAMPLES:], rates[-MOST_SAMPLES:]

    def integral(self, start_s: float, end_s: float) -> RateIntegral | None:
        """Return the integral of the rates over an interval.

        The rates are linear between samples. None where the samples leave a gap.
        """
        first = int(np.searchsorted(self._times, start_s, side="right")) - 1
        last = int(np.searchsorted(self._times, end_s, side="left"))
        if first < 0 or end_s <= start_s:
            return None
        inner = slice(first, min(last + 1, len(self._times)))
        known = self._times[inner]
        if np.diff(known).max(initial=0.0) > LONGEST_GAP_S or end_s - known[-1] > LONGEST_GAP_S:
            return None
        times = np.concatenate([[start_s], known[(known > start_s) & (known < end_s)], [end_s]])
        rates = np.column_stack([np.interp(times, known, column) for column in self._rates[inner].T])
        total = ((rates[1:] + rates[:-1]) / 2 * np.diff(times)[:, None]).sum(axis=0)
        return RateIntegral(total, rates[-1] - rates[0])

    def missing_s(self, end_s: float) -> float:
        """Return the time before the end of an interval over which `integral` holds the rates of the last sample."""
        return max(0.0, end_s - float(self._times[-1])) if len(self._times) else 0.0

    def largest(self, start_s: float, end_s: float, zero: Array) -> Array | None:
        """Return the largest differences (size,) of the rates in an interval from zero (size,); None if empty."""
        inner = self._rates[(self._times >= start_s) & (self._times <= end_s)] - zero
        return np.asarray(np.abs(inner).max(axis=0)) if len(inner) else None


@dataclass(frozen=True, slots=True)
class SensedMotion:
    """Motion of the rectified frame from one pair to the next by wheels and gyro, as a twist over the whole step."""

    twist: Array  # (6,) [t; r] m, rad: T_prev_curr = exp(twist), an arc for a base on wheels
    noise: Array  # (6, 6) covariance of the twist by errors that are independent from step to step
    systematic: Array  # (6, 6) by errors that are the same in all steps, of scales and bias
    is_complete: bool  # distance and turn are known: the position follows from it

    @property
    def covariance(self) -> Array:
        """Covariance (6, 6) of the twist by all errors."""
        return self.noise + self.systematic

    @property
    def T_prev_curr(self) -> Array:
        """The motion (4, 4)."""
        return se3.exp(self.twist)
