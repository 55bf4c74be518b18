"""Wheels and gyro: the motion that they measure, and their errors, which are estimated on the way.

The motion of cameras is the reference while they track. A Kalman filter of seven states (scale of the wheels' distance
and of their turn, clock offsets of wheels and gyro, bias of the gyro) takes the difference of both motions in each
step. The motion by the sensors then predicts the next pose, and bridges darkness and plain walls.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Final, NamedTuple

import numpy as np
from filterpy.kalman import KalmanFilter
from numpy.typing import NDArray

from calib import se3
from drivers.motion import GyroSample, MotionSample, WheelSample
from omnid.core.nanoseconds import SecondsSinceFirst

Array = NDArray[np.float64]

# States: scales of the wheels' distance and turn, offsets [s] that are added to the stamps of wheels and gyro, and bias
# (3,) [rad/s] of the gyro, in the order of a vector so that each has an index.
DISTANCE, TURN, WHEEL_OFFSET, GYRO_OFFSET, BIAS = 0, 1, 2, 3, slice(4, 7)
START: Final = np.array([1.0, 1.0, 0.0, 0.0, 0.0, 0.0, 0.0])
# Standard deviations of the start, and those of the states' random walks over one second.
START_SIGMA: Final = np.array([0.05, 0.1, 0.02, 0.02, 0.02, 0.02, 0.02])
WALK_SIGMA: Final = np.array([2e-4, 5e-4, 1e-5, 1e-5, 5e-5, 5e-5, 5e-5])
# The same after many steps that do not agree, so large that all is learned again.
LOST_SIGMA: Final = np.array([1.0, 1.0, 0.1, 0.1, 0.2, 0.2, 0.2])
# Errors of a step that are independent of those of other steps, by sigma. Shares of the wheels' distance and turn,
# for roughness and slack.
DISTANCE_SHARE, TURN_SHARE = 0.01, 0.02
WHEEL_M, WHEEL_RAD = 3e-4, 5e-4  # Least errors of the wheels, for the steps of encoders.
# Lateral and vertical errors; wheels roll forwards on a plane.
SIDE_SHARE, SIDE_M, HEIGHT_M = 0.01, 3e-4, 5e-4
GYRO_RADPS_SQRT_S = 1e-3  # Noise of the gyro over one second.
TILT_RAD = 1e-3  # Rotation about x and y without a gyro.
CAMERA_M, CAMERA_RAD = 3e-4, 1e-4  # Added to the covariance of the cameras' step.
STILL_M, STILL_RAD = 1e-4, 5e-5  # Motion of a base at rest.
# Sigmas of the change of the rates, m/s^2 and rad/s^2, where samples of the end of a step have not come yet: about half
# of the most that controller.limits allows by default, 1.5 m/s^2 and 4 rad/s^2.
NOT_YET_MPS2, NOT_YET_RADPS2 = 1.0, 2.0
# m/s and rad/s, without the bias, below which they are at rest.
STILL_WHEELS, STILL_GYRO = np.array([0.003, 0.01]), 0.03
STILL_BEFORE_S = 0.2  # The sensors must have been at rest this long before the step, so that none swings on.
# The noise of wheels depends on floor and tyres: its variance is multiplied by a factor of 1 or more, which follows the
# mean of the squared differences by their expected values, over 50 steps because a floor is the same for some seconds.
# Ratios beyond the limit, 4 sigmas, do not count, because slip is no noise.
NOISE_GAIN, RATIO_LIMIT = 0.02, 16.0
# A larger difference from the cameras' step means that a sensor slips or is wrong, because noise makes one of a million
# so large.
OUTLIER_SIGMA = 5.0
# Consecutive outliers of wheels that mean slip, because a single one may be a bump. They are counted, and not timed,
# because each step is another measurement.
SLIPPING = 2
MOST_OUTLIERS = 40  # Consecutive outliers after which the sensor counts as not calibrated.
SANE_SCALE = (0.5, 2.0)  # Limits of the wheels' scales, because beyond them their settings are wrong.
# Sigma of a motion that no sensor measures in a step, so large that it has no weight, because nothing is known.
UNKNOWN_M, UNKNOWN_RAD = 1e3, 1e2
LONGEST_GAP_S = 0.15  # Longest gap between samples, and before the end of an interval.
MOST_SAMPLES = 4096  # Samples that are kept, so that memory is bounded: 16 seconds of a sensor of 250 Hz.


class RateHistory:
    """The newest samples of one sensor: times [s] and rates, in the order of the times.

    Rates are linear between samples, and after the last one they stay for LONGEST_GAP_S.
    """

    def __init__(self, size: int) -> None:
        """size: numbers of a sample."""
        self._times, self._rates = np.zeros(0), np.zeros((0, size))

    def add(self, times_s: Array, rates: Array) -> None:
        """Add samples at times (N,) with rates (N, size); one at a known time replaces the other."""
        times, first = np.unique(np.concatenate([times_s, self._times]), return_index=True)
        rates = np.concatenate([rates, self._rates])[first]
        self._times, self._rates = times[-MOST_SAMPLES:], rates[-MOST_SAMPLES:]

    def integrals(self, starts_s: Array, ends_s: Array) -> Array:
        """Return the integrals (..., size) of the rates over intervals; NaN where the samples leave a gap."""
        if not len(self._times):
            return np.full((*starts_s.shape, self._rates.shape[1]), np.nan)
        first = max(0, int(np.searchsorted(self._times, starts_s.min(), side="right")) - 1)
        times = np.append(self._times[first:], self._times[-1] + LONGEST_GAP_S)
        rates = np.concatenate([self._rates[first:], self._rates[-1:]])
        # 1. Integrals up to the samples, and gaps before them. Rounding makes no gap after the last one.
        steps = np.diff(times)
        zero = np.zeros((1, rates.shape[1]))
        totals = np.concatenate([zero, np.cumsum((rates[1:] + rates[:-1]) / 2 * steps[:, None], axis=0)])
        gaps = np.append(0, np.cumsum(steps[:-1] > LONGEST_GAP_S))
        # 2. Those up to the start and the end.
        at_ends = []
        for when in (starts_s, ends_s):
            k = np.clip(np.searchsorted(times, when, side="right") - 1, 0, len(steps) - 1)
            since = (when - times[k])[..., None]
            slopes = (rates[k + 1] - rates[k]) / steps[k][..., None]
            is_known = (when >= times[0]) & (when <= times[-1])
            at_ends.append(np.where(is_known[..., None], totals[k] + since * (rates[k] + slopes * since / 2), np.nan))
        last = np.clip(np.searchsorted(times, ends_s, side="left"), 0, len(gaps) - 1)
        first_at = np.clip(np.searchsorted(times, starts_s, side="right") - 1, 0, len(gaps) - 1)
        has_gap = gaps[last] > gaps[first_at]
        return np.where(has_gap[..., None], np.nan, at_ends[1] - at_ends[0])

    def rate(self, when_s: float) -> Array:
        """Return the rates (size,) at a time."""
        return np.array([np.interp(when_s, self._times, column) for column in self._rates.T])

    def missing_s(self, end_s: float) -> float:
        """Return the time before the end of an interval over which `integrals` holds the rates of the last sample."""
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


AHEAD, YAW = 0, 5  # components of the twist of the base that wheels measure


class _Measured(NamedTuple):
    """One component of the twist of the base in a step, by a sensor."""

    value: float  # m, rad
    slopes: Array  # (7,) by the states
    variance: float  # by errors that are independent from step to step


class MotionSensors:
    """The samples of wheels and gyro, and the estimate of their errors. The base moves along arcs, on a plane.

    slips counts steps in which the wheels moved otherwise than the cameras; refused, those of the gyro.
    """

    def __init__(self, T_rect_base: Array) -> None:
        self._to_rect, self._to_base = se3.adjoint(T_rect_base), se3.adjoint(se3.inverse(T_rect_base))
        self._wheels, self._gyro = RateHistory(2), RateHistory(3)
        self._filter = KalmanFilter(dim_x=len(START), dim_z=1)
        self._filter.x = START[:, None].copy()
        self._filter.P = np.diag(START_SIGMA**2)
        self.seconds = SecondsSinceFirst().seconds
        self._outliers = {WheelSample: 0, GyroSample: 0}
        self.slips = self.refused = self.steps = 0
        self.is_slipping = False  # True if the wheels slipped in the last steps that the cameras saw
        self._disagreements = 0  # consecutive steps in which the turns of wheels and gyro differ
        self._noise_factors = {AHEAD: 1.0, YAW: 1.0}

    @property
    def values(self) -> Array:
        """Estimates (7,): scales of distance and turn, offsets of wheels and gyro [s], bias of the gyro [rad/s]."""
        return np.array(self._filter.x[:, 0])

    @property
    def sigmas(self) -> Array:
        """Standard deviations (7,) of the values."""
        return np.asarray(np.sqrt(np.diag(self._filter.P)))

    @property
    def wheels_are_sane(self) -> bool:
        """False if the wheels' scales are so far from 1 that their settings must be wrong."""
        return bool(all(SANE_SCALE[0] < scale < SANE_SCALE[1] for scale in self.values[[DISTANCE, TURN]]))

    def add(self, samples: Iterable[MotionSample]) -> None:
        """Add samples; they may come late, and in any order."""
        wheels: list[tuple[float, ...]] = []
        gyro: list[tuple[float, ...]] = []
        for sample in samples:
            if isinstance(sample, WheelSample):
                wheels.append((self.seconds(sample.stamp_ns), sample.velocity_mps, sample.yaw_rate_radps))
            else:
                gyro.append((self.seconds(sample.stamp_ns), sample.x_radps, sample.y_radps, sample.z_radps))
        for history, rows in ((self._wheels, wheels), (self._gyro, gyro)):
            if rows:
                table = np.array(rows)
                history.add(table[:, 0], table[:, 1:])

    def between(self, start_ns: int, end_ns: int) -> SensedMotion | None:
        """Return the motion between two stamps, None where the sensors do not cover it.

        Wheels that slipped in the last two steps that the cameras saw are left out, and so are those whose turn differs
        from that of the gyro twice in a row.
        """
        # 1. What the sensors measured in this time; the wheels only while they can be trusted.
        start_s, end_s = self.seconds(start_ns), self.seconds(end_ns)
        trusted = self.wheels_are_sane and not self.is_slipping
        wheels = self._by_wheels(start_s, end_s) if trusted else {}
        gyro = self._by_gyro(start_s, end_s)
        if not wheels and not gyro:
            return None
        # 2. At rest the motion is zero.
        if wheels and self._is_at_rest(start_s, end_s):
            return self._in_rect(np.zeros(6), np.repeat([STILL_M, STILL_RAD], 3), np.zeros((6, 7)), complete=True)
        # 3. Wheels whose turn differs from that of the gyro slip.
        disagree = AHEAD in wheels and YAW in wheels and YAW in gyro and self._disagree(wheels[YAW], gyro[YAW])
        self._disagreements = self._disagreements + 1 if disagree else 0
        if self._disagreements >= SLIPPING:
            wheels = {}
            self.slips += 1
        # 4. The twist (6,) of the base with independent errors (6,) and slopes (6, 7) by the states; errors of the
        #    clocks do not add up from step to step. The rotation is that of the gyro where there is one.
        twist, sigma, slopes = np.zeros(6), np.repeat([UNKNOWN_M, UNKNOWN_RAD], 3), np.zeros((6, 7))
        if wheels:
            aside_m = math.hypot(SIDE_SHARE * wheels[AHEAD].value, SIDE_M)
            sigma[1:5] = aside_m, HEIGHT_M, TILT_RAD, TILT_RAD
        for axis, found in (wheels | gyro).items():
            twist[axis], sigma[axis], slopes[axis] = found.value, math.sqrt(found.variance), found.slopes
        slopes[:, [WHEEL_OFFSET, GYRO_OFFSET]] = 0.0
        return self._in_rect(twist, sigma, slopes, complete=bool(wheels) and sigma[YAW] < UNKNOWN_RAD)

    def _disagree(self, wheels: _Measured, gyro: _Measured) -> bool:
        """True if wheels and gyro measure turns in a step that differ by more than their errors: a wheel slips."""
        H = wheels.slopes - gyro.slopes
        variance = wheels.variance + gyro.variance + float(H @ self._filter.P @ H)
        return (wheels.value - gyro.value) ** 2 > OUTLIER_SIGMA**2 * variance

    def observe(self, T_prev_curr: Array, covariance: Array, start_ns: int, end_ns: int) -> None:
        """Estimate the states by a step of the rectified frame that the cameras measured, with covariance (6, 6)."""
        # 1. The step and its variances in the frame of the base.
        start_s, end_s = self.seconds(start_ns), self.seconds(end_ns)
        seen = self._to_base @ se3.log(T_prev_curr)
        variance = np.diag(self._to_base @ covariance @ self._to_base.T)
        variance = variance + np.repeat([CAMERA_M**2, CAMERA_RAD**2], 3)
        # 2. Predict the states: they change by random walks.
        self._filter.predict(F=np.eye(len(START)), Q=np.diag(WALK_SIGMA**2 * (end_s - start_s)))
        self.steps += 1
        # 3. Update them by the differences between cameras and sensors.
        if wheels := self._by_wheels(start_s, end_s):
            agree = self._learn(wheels, seen, variance, follows_noise=True)
            self.slips += not agree
            self._count(WheelSample, agree, np.array([DISTANCE, TURN, WHEEL_OFFSET]))
            self.is_slipping = self._outliers[WheelSample] >= SLIPPING
        if gyro := self._by_gyro(start_s, end_s):
            agree = self._learn(gyro, seen, variance, follows_noise=False)
            self.refused += not agree
            self._count(GyroSample, agree, np.array([GYRO_OFFSET, 4, 5, 6]))

    def _learn(self, measured: dict[int, _Measured], seen: Array, variance: Array, *, follows_noise: bool) -> bool:
        """Learn from the cameras' twist (6,) with variances (6,); return whether the sensor agrees with it."""
        agree = True
        for axis, (value, H, own) in measured.items():
            error, noise = float(seen[axis] - value), float(variance[axis] + own)
            ratio = error**2 / (float(H @ self._filter.P @ H) + noise)
            if follows_noise and ratio < RATIO_LIMIT:
                factor = self._noise_factors[axis] * (1.0 + NOISE_GAIN * (ratio - 1.0))
                self._noise_factors[axis] = max(1.0, factor)
            agree &= self._update(error, H, noise)
        return agree

    def _update(self, error: float, H: Array, variance: float) -> bool:
        """Update the states with one error, of which H (7,) are the derivatives; False if it is an outlier."""
        expected = float(H @ self._filter.P @ H) + variance
        if error**2 > OUTLIER_SIGMA**2 * expected:
            return False
        self._filter.update(np.array([[error + float(H @ self.values)]]), R=np.array([[variance]]), H=H[None])
        self._filter.P = (self._filter.P + self._filter.P.T) / 2
        return True

    def _count(self, sensor: type[MotionSample], agrees: bool, states: NDArray[np.int64]) -> None:
        """Count the outliers of a sensor; after MOST_OUTLIERS its states start again, as its settings may be wrong."""
        self._outliers[sensor] = 0 if agrees else self._outliers[sensor] + 1
        if self._outliers[sensor] > MOST_OUTLIERS:
            self._outliers[sensor] = 0
            self._filter.P[states] = self._filter.P[:, states] = 0.0
            self._filter.P[states, states] = LOST_SIGMA[states] ** 2

    def motion(self, sensor: type[MotionSample], starts_s: Array, ends_s: Array) -> Array:
        """Return distance and turn (..., 2) by wheels, or the turns (..., 3) by a gyro without its bias, as reported.

        The times [s] are those of `seconds`; NaN where no samples cover an interval.
        """
        if sensor is WheelSample:
            return self._wheels.integrals(starts_s, ends_s)
        return np.asarray(self._gyro.integrals(starts_s, ends_s) - self.values[BIAS] * (ends_s - starts_s)[..., None])

    def _by_wheels(self, start_s: float, end_s: float) -> dict[int, _Measured]:
        """Return the components of the base's twist that the wheels measure in a time."""
        start_s, end_s = start_s - self.values[WHEEL_OFFSET], end_s - self.values[WHEEL_OFFSET]
        amounts, found = self.motion(WheelSample, np.array(start_s), np.array(end_s)), {}
        if np.isfinite(amounts).any():
            changes, missing_s = self._wheels.rate(end_s) - self._wheels.rate(start_s), self._wheels.missing_s(end_s)
        limits = (
            (AHEAD, DISTANCE, DISTANCE_SHARE, WHEEL_M, NOT_YET_MPS2),
            (YAW, TURN, TURN_SHARE, WHEEL_RAD, NOT_YET_RADPS2),
        )
        for number, (axis, state, share, least, change) in enumerate(limits):
            amount, slopes = float(amounts[number]), np.zeros(len(START))
            if math.isfinite(amount):
                slopes[state], slopes[WHEEL_OFFSET] = amount, -self.values[state] * changes[number]
                noise = self._noise_factors[axis] * ((share * amount) ** 2 + least**2)
                value, late = float(self.values[state] * amount), change * missing_s**2 / 2
                found[axis] = _Measured(value, slopes, noise + late**2)
        return found

    def _by_gyro(self, start_s: float, end_s: float) -> dict[int, _Measured]:
        """Return the components of the base's twist that the gyro measures in a time."""
        dt_s, start_s, end_s = end_s - start_s, start_s - self.values[GYRO_OFFSET], end_s - self.values[GYRO_OFFSET]
        amounts, found = self.motion(GyroSample, np.array(start_s), np.array(end_s)), {}
        if not np.isfinite(amounts).all():
            return {}
        changes = self._gyro.rate(end_s) - self._gyro.rate(start_s)
        late = NOT_YET_RADPS2 * self._gyro.missing_s(end_s) ** 2 / 2
        for axis in range(3):
            slopes = np.zeros(len(START))
            slopes[BIAS.start + axis], slopes[GYRO_OFFSET] = -dt_s, -changes[axis]
            found[3 + axis] = _Measured(float(amounts[axis]), slopes, GYRO_RADPS_SQRT_S**2 * dt_s + late**2)
        return found

    def _is_at_rest(self, start_s: float, end_s: float) -> bool:
        """True if wheels, and the gyro if there is one, are at rest in a step and STILL_BEFORE_S before it."""
        wheels = self._wheels.largest(start_s - STILL_BEFORE_S, end_s, np.zeros(2))
        gyro = self._gyro.largest(start_s - STILL_BEFORE_S, end_s, self.values[BIAS])
        if wheels is None or not (wheels < STILL_WHEELS).all():
            return False
        return gyro is None or bool((gyro < STILL_GYRO).all())

    def _in_rect(self, twist: Array, sigma: Array, slopes: Array, *, complete: bool) -> SensedMotion:
        """Return a motion of the base, with slopes (6, 7) by the states, as one of the rectified frame."""
        A = self._to_rect
        systematic = slopes @ self._filter.P @ slopes.T
        return SensedMotion(A @ twist, A @ np.diag(sigma**2) @ A.T, A @ systematic @ A.T, complete)
