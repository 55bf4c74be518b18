"""Samples of wheels and gyro, and what they say about the motion of the base in a step.

The base moves along arcs on a plane. A sensor has errors that are the same in all steps: scales of the wheels' distance
and turn, bias of the gyro. The motion filter estimates them as states (motion_filter.py). An offset of its clock moves
the ends of a step: what the rate changes by in between is noise, and does not add up from step to step.
"""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Annotated, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from calib import se3
from drivers.motion import GyroSample, MotionSample, WheelSample
from omnid.core.nanoseconds import SecondsSinceFirst

Array = NDArray[np.float64]

# States: scales of the wheels' distance and turn, and bias (3,) [rad/s] of the gyro.
DISTANCE, TURN, BIAS = 0, 1, slice(2, 5)
AHEAD, ROLL, YAW = 0, 3, 5  # components of the twist of the base: wheels measure two, a gyro the last three
# Errors of a step that are independent of those of other steps, by sigma: shares of the wheels' distance and turn for
# roughness and slack, least errors for the steps of encoders, noise of the gyro over one second.
WHEEL_SHARES, WHEEL_LEAST, GYRO_RADPS_SQRT_S = (0.02, 0.04), (6e-4, 1e-3), 1e-3
# Sigmas of an acceleration that is not known, m/s^2 and rad/s^2: about half of the most that controller.limits allows
# by default, 1.5 m/s^2 and 3 rad/s^2.
ACCELERATION_SIGMAS: Final = (1.0, 2.0)
OFFSET_S = 0.02  # standard deviation of the clocks of wheels and gyro against that of the images
LONGEST_GAP_S = 0.15  # Longest gap between samples, and before the end of an interval.
MOST_SAMPLES = 4096  # Samples that are kept, so that memory is bounded: 16 seconds of a sensor of 250 Hz.


@dataclass(frozen=True, slots=True)
class MotionSensorSettings:
    """Wheels and gyro in addition to the cameras. Scales and bias are estimated on the way."""

    wheels: Annotated[
        str,
        "speeds of the wheels; auto: those that the motor controller reports, of the bus (cmd/wheel_odom), or of the "
        "only topic of a log with nav_msgs/msg/Odometry whose name contains 'wheel'; off; or that topic of the log",
    ] = "auto"
    imu: Annotated[
        str,
        "gyro; auto: that of the bus (cmd/imu), or of the only topic of a log with sensor_msgs/msg/Imu; off; or that "
        "topic of the log",
    ] = "auto"
    imu_rpy_deg: Annotated[
        tuple[float, float, float],
        "orientation of the IMU on the base: roll about x, then pitch about y, then yaw about z, deg; not applied to "
        "messages in the frame base_link",
    ] = (0.0, 0.0, 0.0)

    @property
    def R_base_imu(self) -> Array:
        """Rotation (3, 3) from the axes of the IMU to those of the base."""
        roll, pitch, yaw = np.radians(self.imu_rpy_deg)
        turns = ([0, 0, yaw], [0, pitch, 0], [roll, 0, 0])
        return np.asarray(np.linalg.multi_dot([se3.rotation_exp(turn) for turn in turns]))


class RateHistory:
    """The newest samples of one sensor: times [s] and rates, in the order of the times.

    Rates are linear between samples, and after the last one they stay for LONGEST_GAP_S.
    """

    def __init__(self, size: int) -> None:
        """size: numbers of a sample."""
        self._times, self._rates = np.zeros(0), np.zeros((0, size))

    def add(self, samples: list[tuple[float, ...]]) -> None:
        """Add samples, each a time and its rates; one at a known time replaces the other."""
        table = np.array(samples).reshape(-1, 1 + self._rates.shape[1])
        times, first = np.unique(np.concatenate([table[:, 0], self._times]), return_index=True)
        rates = np.concatenate([table[:, 1:], self._rates])[first]
        self._times, self._rates = times[-MOST_SAMPLES:], rates[-MOST_SAMPLES:]

    def at(self, times_s: Array) -> Array:
        """Return the rates (..., size) at times."""
        return np.stack([np.interp(times_s, self._times, each) for each in self._rates.T], axis=-1)

    def integrals(self, starts_s: Array, ends_s: Array) -> Array:
        """Return the integrals (..., size) of the rates over intervals; NaN where the samples leave a gap."""
        if not len(self._times):
            return np.full((*np.shape(starts_s), self._rates.shape[1]), np.nan)
        # 1. Integrals up to all samples, starts and ends, between which rates are linear.
        grid = np.unique(np.concatenate([self._times, np.ravel(starts_s), np.ravel(ends_s)]))
        rates = self.at(grid)
        areas = (rates[1:] + rates[:-1]) / 2 * np.diff(grid)[:, None]
        totals = np.concatenate([np.zeros((1, rates.shape[1])), np.cumsum(areas, axis=0)])
        whole = totals[np.searchsorted(grid, ends_s)] - totals[np.searchsorted(grid, starts_s)]
        # 2. Gaps in them.
        gaps = np.append(0, np.cumsum(np.diff(self._times) > LONGEST_GAP_S))
        first = np.clip(np.searchsorted(self._times, starts_s, side="right") - 1, 0, None)
        last = np.clip(np.searchsorted(self._times, ends_s), 0, len(gaps) - 1)
        is_known = (
            (starts_s >= self._times[0]) & (ends_s <= self._times[-1] + LONGEST_GAP_S) & (gaps[last] == gaps[first])
        )
        return np.where(is_known[..., None], whole, np.nan)

    def variance_of_ends(self, start_s: Array, end_s: Array, acceleration: Array) -> Array:
        """Return the variances (size,) of an integral by the offset of the clock, and by what is missing at its end.

        acceleration (size,): standard deviation of the change of the rates after the last sample.
        """
        moved = OFFSET_S * (self.at(end_s) - self.at(start_s))
        missing = acceleration * max(0.0, float(end_s - self._times[-1])) ** 2 / 2
        return np.asarray(moved**2 + missing**2)


class Measured(NamedTuple):
    """One component of the twist of the base in a step, by a sensor."""

    value: float  # m, rad
    slopes: Array  # (5,) by the states
    variance: float  # by errors that are independent from step to step


Twist = dict[int, Measured]  # by the component, [t; r] of the base


class MotionSensors:
    """The samples of wheels and gyro."""

    def __init__(self) -> None:
        self._histories: dict[type[MotionSample], RateHistory] = {
            WheelSample: RateHistory(2),
            GyroSample: RateHistory(3),
        }
        self.seconds = SecondsSinceFirst().seconds

    def add(self, samples: Iterable[MotionSample]) -> None:
        """Add samples; they may come late, and in any order."""
        new = defaultdict[type[MotionSample], list[tuple[float, ...]]](list)
        for sample in samples:
            if isinstance(sample, WheelSample):
                rates: tuple[float, ...] = sample.velocity_mps, sample.yaw_rate_radps
            else:
                rates = sample.x_radps, sample.y_radps, sample.z_radps
            new[type(sample)].append((self.seconds(sample.stamp_ns), *rates))
        for sensor, found in new.items():
            self._histories[sensor].add(found)

    def motion(self, sensor: type[MotionSample], starts_s: Array, ends_s: Array, states: Array) -> Array:
        """Return distance and turn (..., 2) by wheels, or the turns (..., 3) by a gyro without its bias, as reported.

        The times [s] are those of `seconds`; NaN where no samples cover an interval.
        """
        moved = self._histories[sensor].integrals(starts_s, ends_s)
        return moved if sensor is WheelSample else moved - states[BIAS] * (ends_s - starts_s)[..., None]

    def measured(self, sensor: type[MotionSample], interval_s: tuple[float, float], states: Array) -> Twist:
        """Return what a sensor measures in a step: wheels distance and turn, each if it is known, a gyro all turns."""
        start_s, end_s = (np.array(time_s) for time_s in interval_s)
        amounts, dt_s, found = self.motion(sensor, start_s, end_s, states), interval_s[1] - interval_s[0], Twist()
        if not np.isfinite(amounts).any():
            return found
        is_wheels = sensor is WheelSample
        acceleration = np.array(ACCELERATION_SIGMAS if is_wheels else ACCELERATION_SIGMAS[1:])
        of_ends = self._histories[sensor].variance_of_ends(start_s, end_s, acceleration)
        for number, amount in enumerate(amounts.tolist()):
            slopes = np.zeros(len(states))
            if is_wheels and math.isfinite(amount):
                slopes[number] = amount
                noise = (WHEEL_SHARES[number] * amount) ** 2 + WHEEL_LEAST[number] ** 2
                found[(AHEAD, YAW)[number]] = Measured(states[number] * amount, slopes, noise + of_ends[number])
            elif not is_wheels:
                slopes[BIAS.start + number] = -dt_s
                found[ROLL + number] = Measured(amount, slopes, GYRO_RADPS_SQRT_S**2 * dt_s + of_ends[number])
        return found


def on_a_plane(wheels: Twist, states: Array) -> Twist:
    """Return the twist of a base whose wheels measure a part of it: it rolls forwards on a plane.

    It leaves the plane, and moves to the side, by as much as wheels err.
    """
    least_m, least_rad = WHEEL_LEAST
    aside_m = math.hypot(WHEEL_SHARES[0] * wheels[AHEAD].value, least_m) if AHEAD in wheels else least_m
    sigmas = {1: aside_m, 2: least_m, ROLL: least_rad, ROLL + 1: least_rad}
    return {axis: Measured(0.0, np.zeros(len(states)), sigma**2) for axis, sigma in sigmas.items()} | wheels
