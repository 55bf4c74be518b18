"""Wheels and gyro: the motion that they measure, and their errors, which are estimated on the way.

The motion of cameras is the reference while they track. A Kalman filter of seven states (scale of the wheels' distance
and of their turn, clock offsets of wheels and gyro, bias of the gyro) takes the difference of both motions in each
step. The motion by the sensors then predicts the next pose, and bridges darkness and plain walls.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from typing import Final

import numpy as np
from numpy.typing import NDArray

from calib import se3
from drivers.motion import GyroSample, MotionSample, WheelSample
from omnid.core.kalman_filter import kalman_filter
from omnid.core.nanoseconds import SecondsSinceFirst
from omnid.core.odometry.motion_filter import RateHistory, RateIntegral, SensedMotion

Array = NDArray[np.float64]

# States: scales of the wheels' distance and turn, offsets [s] that are added to the stamps of wheels and gyro, and bias
# (3,) [rad/s] of the gyro; their start, its standard deviations, and those of their random walks over one second.
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


class MotionSensors:
    """The samples of wheels and gyro, and the estimate of their errors. The base moves along arcs, on a plane.

    slips counts steps in which the wheels moved otherwise than the cameras; refused, those of the gyro.
    """

    def __init__(self, T_rect_base: Array) -> None:
        self._to_rect, self._to_base = se3.adjoint(T_rect_base), se3.adjoint(se3.inverse(T_rect_base))
        self._wheels, self._gyro = RateHistory(2), RateHistory(3)
        self._filter = kalman_filter(dim_x=len(START), dim_z=1)
        self._filter.x = START[:, None].copy()
        self._filter.P = np.diag(START_SIGMA**2)
        self._clock = SecondsSinceFirst()
        self._outliers = {WheelSample: 0, GyroSample: 0}
        self.slips = self.refused = self.steps = 0
        self.is_slipping = False  # True if the wheels slipped in the last steps that the cameras saw
        self._disagreements = 0  # consecutive steps in which the turns of wheels and gyro differ
        self._noise_factors = {DISTANCE: 1.0, TURN: 1.0}

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
                wheels.append((self._clock.seconds(sample.stamp_ns), sample.velocity_mps, sample.yaw_rate_radps))
            else:
                gyro.append((self._clock.seconds(sample.stamp_ns), sample.x_radps, sample.y_radps, sample.z_radps))
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
        start_s, end_s = self._clock.seconds(start_ns), self._clock.seconds(end_ns)
        dt_s = end_s - start_s
        trusted = self.wheels_are_sane and not self.is_slipping
        wheels = self._of_wheels(start_s, end_s) if trusted else None
        gyro = self._of_gyro(start_s, end_s)
        if wheels is None and gyro is None:
            return None
        # 2. At rest the motion is zero.
        if wheels is not None and self._is_at_rest(start_s, end_s):
            return self._in_rect(np.zeros(6), np.repeat([STILL_M, STILL_RAD], 3), np.zeros((6, 7)), complete=True)
        # 3. Wheels whose turn differs from that of the gyro slip.
        disagree = wheels is not None and gyro is not None and self._disagree(wheels, gyro, dt_s)
        self._disagreements = self._disagreements + 1 if disagree else 0
        if self._disagreements >= SLIPPING:
            wheels = None
            self.slips += 1
        # 4. The twist (6,) of the base with independent errors (6,) and slopes (6, 7) by the states. The rotation is
        # that of the gyro where there is one.
        twist, sigma, slopes = np.zeros(6), np.repeat([UNKNOWN_M, UNKNOWN_RAD], 3), np.zeros((6, 7))
        if wheels is not None:
            distance, turn = wheels.amounts
            twist[0], slopes[0, DISTANCE] = self.values[DISTANCE] * distance, distance
            rough = math.sqrt(self._noise_factors[DISTANCE])
            missing_s = self._wheels.missing_s(end_s - self.values[WHEEL_OFFSET])
            sigma[:5] = (
                math.hypot(rough * math.hypot(DISTANCE_SHARE * distance, WHEEL_M), NOT_YET_MPS2 * missing_s**2 / 2),
                math.hypot(SIDE_SHARE * distance, SIDE_M),
                HEIGHT_M,
                TILT_RAD,
                TILT_RAD,
            )
            if math.isfinite(turn):
                twist[5], slopes[5, TURN] = self.values[TURN] * turn, turn
                of_wheels = math.sqrt(self._noise_factors[TURN]) * math.hypot(TURN_SHARE * turn, WHEEL_RAD)
                sigma[5] = math.hypot(of_wheels, NOT_YET_RADPS2 * missing_s**2 / 2)
        if gyro is not None:
            twist[3:] = gyro.amounts - self.values[BIAS] * dt_s
            missing_s = self._gyro.missing_s(end_s - self.values[GYRO_OFFSET])
            sigma[3:] = math.hypot(GYRO_RADPS_SQRT_S * math.sqrt(dt_s), NOT_YET_RADPS2 * missing_s**2 / 2)
            slopes[3:], slopes[3:, BIAS] = 0.0, -dt_s * np.eye(3)
        return self._in_rect(twist, sigma, slopes, complete=wheels is not None and sigma[5] < UNKNOWN_RAD)

    def _disagree(self, wheels: RateIntegral, gyro: RateIntegral, dt_s: float) -> bool:
        """True if wheels and gyro measure turns in a step that differ by more than their errors: a wheel slips."""
        turn, turned = wheels.amounts[1], gyro.amounts[2]
        if not math.isfinite(turn):
            return False
        H = np.zeros(len(START))
        H[TURN], H[BIAS.stop - 1] = turn, dt_s
        difference = self.values[TURN] * turn - (turned - self.values[BIAS][2] * dt_s)
        of_wheels = self._noise_factors[TURN] * ((TURN_SHARE * turn) ** 2 + WHEEL_RAD**2)
        variance = of_wheels + GYRO_RADPS_SQRT_S**2 * dt_s + H @ self._filter.P @ H
        # The offsets of both clocks are not known exactly either: a turn begins in one before it does in the other.
        of_clocks = self.sigmas[WHEEL_OFFSET] * wheels.changes[1], self.sigmas[GYRO_OFFSET] * gyro.changes[2]
        variance += of_clocks[0] ** 2 + of_clocks[1] ** 2
        return bool(difference**2 > OUTLIER_SIGMA**2 * variance)

    def observe(self, T_prev_curr: Array, covariance: Array, start_ns: int, end_ns: int) -> None:
        """Estimate the states by a step of the rectified frame that the cameras measured, with covariance (6, 6)."""
        # 1. The step and its variances in the frame of the base.
        start_s, end_s = self._clock.seconds(start_ns), self._clock.seconds(end_ns)
        dt_s = end_s - start_s
        seen = self._to_base @ se3.log(T_prev_curr)
        variance = np.diag(self._to_base @ covariance @ self._to_base.T)
        variance = variance + np.repeat([CAMERA_M**2, CAMERA_RAD**2], 3)
        # 2. Predict the states: they change by random walks.
        self._filter.predict(F=np.eye(len(START)), Q=np.diag(WALK_SIGMA**2 * dt_s))
        self.steps += 1
        # 3. Update them by the differences between cameras and sensors.
        wheels, gyro = self._of_wheels(start_s, end_s), self._of_gyro(start_s, end_s)
        if wheels is not None:
            self._learn_wheels(wheels, seen, variance)
        if gyro is not None:
            self._learn_gyro(gyro, seen[3:], variance[3:], dt_s)

    def _learn_wheels(self, wheels: RateIntegral, seen: Array, variance: Array) -> None:
        """Learn scales and offset of the wheels from the cameras' twist (6,) with variances (6,)."""
        agree = True
        rows = (
            (DISTANCE, seen[0], variance[0], DISTANCE_SHARE, WHEEL_M),
            (TURN, seen[5], variance[5], TURN_SHARE, WHEEL_RAD),
        )
        for number, (state, truth, noise, share, least) in enumerate(rows):
            amount, change = wheels.amounts[number], wheels.changes[number]
            if not math.isfinite(amount):
                continue
            H = np.zeros(len(START))
            H[state], H[WHEEL_OFFSET] = amount, -self.values[state] * change
            error = truth - self.values[state] * amount
            of_wheels = self._noise_factors[state] * ((share * amount) ** 2 + least**2)
            self._follow_noise(state, error**2 / (float(H @ self._filter.P @ H) + noise + of_wheels))
            agree &= self._update(error, H, noise + of_wheels)
        self.slips += not agree
        self._count(WheelSample, agree, np.array([DISTANCE, TURN, WHEEL_OFFSET]))
        self.is_slipping = self._outliers[WheelSample] >= SLIPPING

    def _follow_noise(self, state: int, ratio: float) -> None:
        """Follow the noise of distance or turn by the square of a difference, divided by its expected value."""
        if ratio < RATIO_LIMIT:
            self._noise_factors[state] = max(1.0, self._noise_factors[state] * (1.0 + NOISE_GAIN * (ratio - 1.0)))

    def _learn_gyro(self, gyro: RateIntegral, seen: Array, variance: Array, dt_s: float) -> None:
        """Learn bias and offset of the gyro from the cameras' rotation (3,) with variances (3,)."""
        agree = True
        for axis in range(3):
            H = np.zeros(len(START))
            H[BIAS.start + axis], H[GYRO_OFFSET] = -dt_s, -gyro.changes[axis]
            error = seen[axis] - (gyro.amounts[axis] - self.values[BIAS][axis] * dt_s)
            agree &= self._update(error, H, variance[axis] + GYRO_RADPS_SQRT_S**2 * dt_s)
        self.refused += not agree
        self._count(GyroSample, agree, np.array([GYRO_OFFSET, 4, 5, 6]))

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

    def _of_wheels(self, start_s: float, end_s: float) -> RateIntegral | None:
        """Return distance and turn of the wheels in a time."""
        offset_s = self.values[WHEEL_OFFSET]
        return self._wheels.integral(start_s - offset_s, end_s - offset_s)

    def _of_gyro(self, start_s: float, end_s: float) -> RateIntegral | None:
        """Return the rotation vector (3,) of the gyro in a time."""
        offset_s = self.values[GYRO_OFFSET]
        return self._gyro.integral(start_s - offset_s, end_s - offset_s)

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
