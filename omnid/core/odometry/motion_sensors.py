"""Samples of wheels and gyro, and what they say about the motion of the base in a step.

The base moves along arcs on a plane. A sensor has errors that are the same in all steps: scales of the wheels' distance
and turn, offsets of the clocks, bias of the gyro. The motion filter estimates them as states (motion_filter.py).
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from drivers.motion import GyroSample, MotionSample, WheelSample
from omnid.core.nanoseconds import SecondsSinceFirst

Array = NDArray[np.float64]

# States: scales of the wheels' distance and turn, offsets [s] that are added to the stamps of wheels and gyro, and bias
# (3,) [rad/s] of the gyro.
DISTANCE, TURN, WHEEL_OFFSET, GYRO_OFFSET, BIAS = 0, 1, 2, 3, slice(4, 7)
AHEAD, YAW = 0, 5  # components of the twist of the base that wheels measure
# Errors of a step that are independent of those of other steps, by sigma: shares of the wheels' distance and turn for
# roughness and slack, least errors for the steps of encoders, noise of the gyro over one second.
WHEEL_SHARES, WHEEL_LEAST, GYRO_RADPS_SQRT_S = (0.01, 0.02), (3e-4, 5e-4), 1e-3
# Wheels roll forwards on a plane: lateral error as a share of the way and at least, vertical error, roll and pitch.
SIDE_SHARE, SIDE_M, HEIGHT_M, TILT_RAD = 0.01, 3e-4, 5e-4, 1e-3
# Sigmas of an acceleration that is not known, m/s^2 and rad/s^2: about half of the most that controller.limits allows
# by default, 1.5 m/s^2 and 3 rad/s^2.
ACCELERATION_SIGMAS: Final = (1.0, 2.0)
# At rest: rates of wheels [m/s, rad/s] and of the gyro without its bias, also for this time before the step, so that
# nothing swings on; and the motion that is left, m and rad.
STILL_WHEELS, STILL_GYRO, STILL_BEFORE_S = np.array([0.003, 0.01]), 0.03, 0.2
STILL_M, STILL_RAD = 1e-4, 5e-5
LONGEST_GAP_S = 0.15  # Longest gap between samples, and before the end of an interval.
MOST_SAMPLES = 4096  # Samples that are kept, so that memory is bounded: 16 seconds of a sensor of 250 Hz.


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

    def missing_s(self, end_s: float) -> float:
        """Return the time before the end of an interval over which `integrals` holds the rates of the last sample."""
        return max(0.0, end_s - float(self._times[-1]))

    def is_below(self, start_s: float, end_s: float, zero: Array, limits: Array | float) -> bool | None:
        """Return whether the rates in an interval differ from zero (size,) by less than limits; None: no samples."""
        inner = self._rates[(self._times >= start_s) & (self._times <= end_s)] - zero
        return bool((np.abs(inner) < limits).all()) if len(inner) else None


class Measured(NamedTuple):
    """One component of the twist of the base in a step, by a sensor."""

    value: float  # m, rad
    slopes: Array  # (7,) by the states
    variance: float  # by errors that are independent from step to step


Twist = dict[int, Measured]  # by the component, [t; r] of the base


class MotionSensors:
    """The samples of wheels and gyro."""

    def __init__(self) -> None:
        self._wheels, self._gyro = RateHistory(2), RateHistory(3)
        self.seconds = SecondsSinceFirst().seconds

    def add(self, samples: Iterable[MotionSample]) -> None:
        """Add samples; they may come late, and in any order."""
        wheels: list[tuple[float, ...]] = []
        gyro: list[tuple[float, ...]] = []
        for sample in samples:
            if isinstance(sample, WheelSample):
                wheels.append((self.seconds(sample.stamp_ns), sample.velocity_mps, sample.yaw_rate_radps))
            else:
                gyro.append((self.seconds(sample.stamp_ns), sample.x_radps, sample.y_radps, sample.z_radps))
        self._wheels.add(wheels)
        self._gyro.add(gyro)

    def motion(self, sensor: type[MotionSample], starts_s: Array, ends_s: Array, states: Array) -> Array:
        """Return distance and turn (..., 2) by wheels, or the turns (..., 3) by a gyro without its bias, as reported.

        The times [s] are those of `seconds`; NaN where no samples cover an interval.
        """
        if sensor is WheelSample:
            return self._wheels.integrals(starts_s, ends_s)
        return np.asarray(self._gyro.integrals(starts_s, ends_s) - states[BIAS] * (ends_s - starts_s)[..., None])

    def by_wheels(self, interval_s: tuple[float, float], states: Array, noise_factors: Array) -> Twist:
        """Return what the wheels measure in a step: distance and turn, each if it is known."""
        start_s, end_s = np.array(interval_s) - states[WHEEL_OFFSET]
        amounts, found = self.motion(WheelSample, start_s, end_s, states), Twist()
        if not np.isfinite(amounts).any():
            return found
        changes = np.diff(self._wheels.at(np.array([start_s, end_s])), axis=0)[0]
        missing_s = self._wheels.missing_s(end_s)
        for number, (axis, state) in enumerate(((AHEAD, DISTANCE), (YAW, TURN))):
            amount, slopes = float(amounts[number]), np.zeros(len(states))
            if math.isfinite(amount):
                slopes[state], slopes[WHEEL_OFFSET] = amount, -states[state] * changes[number]
                noise = noise_factors[number] * ((WHEEL_SHARES[number] * amount) ** 2 + WHEEL_LEAST[number] ** 2)
                late = ACCELERATION_SIGMAS[number] * missing_s**2 / 2
                found[axis] = Measured(float(states[state] * amount), slopes, noise + late**2)
        return found

    def by_gyro(self, interval_s: tuple[float, float], states: Array) -> Twist:
        """Return what the gyro measures in a step: the turns about all axes."""
        start_s, end_s = np.array(interval_s) - states[GYRO_OFFSET]
        amounts, found, dt_s = self.motion(GyroSample, start_s, end_s, states), Twist(), end_s - start_s
        if not np.isfinite(amounts).all():
            return found
        changes = np.diff(self._gyro.at(np.array([start_s, end_s])), axis=0)[0]
        late = ACCELERATION_SIGMAS[1] * self._gyro.missing_s(end_s) ** 2 / 2
        for axis in range(3):
            slopes = np.zeros(len(states))
            slopes[BIAS.start + axis], slopes[GYRO_OFFSET] = -dt_s, -changes[axis]
            found[3 + axis] = Measured(float(amounts[axis]), slopes, GYRO_RADPS_SQRT_S**2 * dt_s + late**2)
        return found

    def are_at_rest(self, interval_s: tuple[float, float], states: Array) -> bool:
        """True if wheels, and the gyro if there is one, are at rest in a step and STILL_BEFORE_S before it."""
        start_s, end_s = interval_s[0] - STILL_BEFORE_S, interval_s[1]
        gyro_rests = self._gyro.is_below(start_s, end_s, states[BIAS], STILL_GYRO)
        return bool(self._wheels.is_below(start_s, end_s, np.zeros(2), STILL_WHEELS)) and gyro_rests is not False


def at_rest(states: Array) -> Twist:
    """Return the twist of a base that does not move."""
    none = np.zeros(len(states))
    return {axis: Measured(0.0, none, (STILL_M if axis < 3 else STILL_RAD) ** 2) for axis in range(6)}


def on_a_plane(wheels: Twist, states: Array) -> Twist:
    """Return the twist of a base whose wheels measure a part of it: it rolls forwards on a plane."""
    aside_m = math.hypot(SIDE_SHARE * wheels[AHEAD].value, SIDE_M) if AHEAD in wheels else SIDE_M
    sigmas = {1: aside_m, 2: HEIGHT_M, 3: TILT_RAD, 4: TILT_RAD}
    return {axis: Measured(0.0, np.zeros(len(states)), sigma**2) for axis, sigma in sigmas.items()} | wheels
