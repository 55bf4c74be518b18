"""The filter of the motion: velocity and acceleration; wheels and gyro with known errors, slip, standstill, gaps."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from calib import se3
from drivers.motion import GyroSample, MotionSample, WheelSample
from omnid.core.odometry.motion_filter import MotionFilter
from omnid.core.odometry.motion_sensors import BIAS, DISTANCE, TURN
from tests.simulation.logs import SensorErrors

Array = NDArray[np.float64]

T_RECT_BASE = se3.exp([0.1, -0.05, -0.4, 0.02, -0.01, 0.7])
PAIR_S, WHEEL_S, GYRO_S = 0.1, 0.02, 0.01
CAMERA_COVARIANCE = np.diag(np.repeat([1e-4, 5e-5], 3) ** 2)
START_NS = 1_795_000_000_000_000_000


def velocity(t_s: Array) -> tuple[Array, Array]:
    """Return velocities and yaw rates (N,) of a drive that starts, turns and stops again and again."""
    moves = np.sin(0.5 * t_s) > 0
    return 0.4 * np.maximum(0.0, np.sin(0.5 * t_s)), 0.6 * np.sin(0.9 * t_s) * moves


def step(start_s: float, end_s: float) -> Array:
    """Return the motion (4, 4) of the base by integration."""
    count = round((end_s - start_s) * 1000)
    fine_s = (end_s - start_s) / count
    speed, rate = velocity(start_s + (np.arange(count) + 0.5) * fine_s)
    yaw = np.cumsum(rate * fine_s) - rate * fine_s / 2
    T = se3.exp([0, 0, 0, 0, 0, rate.sum() * fine_s])
    T[:2, 3] = (speed * np.cos(yaw)).sum() * fine_s, (speed * np.sin(yaw)).sum() * fine_s
    return T


def samples(errors: SensorErrors, start_s: float, end_s: float, rng: np.random.Generator) -> list[MotionSample]:
    """Return the samples of an interval."""
    found: list[MotionSample] = []
    times_s = np.arange(start_s, end_s - 1e-9, WHEEL_S)
    for t_s, speed, rate in zip(times_s, *velocity(times_s), strict=True):
        stamp_ns = START_NS + round((t_s - errors.wheel_offset_s) * 1e9)
        found.append(
            WheelSample(
                stamp_ns,
                speed / errors.distance + rng.normal(0, errors.wheel_sigma[0]),
                rate / errors.turn + rng.normal(0, errors.wheel_sigma[1]),
            )
        )
    times_s = np.arange(start_s, end_s - 1e-9, GYRO_S)
    for t_s, turn in zip(times_s, velocity(times_s)[1], strict=True):
        rates = np.array([0, 0, turn]) + errors.bias_radps + rng.normal(0, errors.gyro_sigma_radps, 3)
        found.append(GyroSample(START_NS + round((t_s - errors.gyro_offset_s) * 1e9), *rates))
    return found


def driven(errors: SensorErrors, seconds: float, seed: int = 1, wheels: bool = True) -> tuple[MotionFilter, float]:
    """Return the filter after a drive with cameras that measure each step, and its end."""
    rng, motion = np.random.default_rng(seed), MotionFilter(T_base_rect=se3.inverse(T_RECT_BASE))
    end_s = 0.0
    for end_s in np.arange(PAIR_S, seconds, PAIR_S):
        new = samples(errors, end_s - PAIR_S, end_s, rng)
        motion.sensors.add([sample for sample in new if wheels or isinstance(sample, GyroSample)])
        observe(motion, end_s, rng)
    return motion, float(end_s)


def observe(motion: MotionFilter, end_s: float, rng: np.random.Generator) -> None:
    """Let the cameras measure a step."""
    T = T_RECT_BASE @ step(end_s - PAIR_S, end_s) @ se3.inverse(T_RECT_BASE)
    T = T @ se3.exp(rng.multivariate_normal(np.zeros(6), CAMERA_COVARIANCE))
    sensed(motion, end_s)
    motion.accept(T, CAMERA_COVARIANCE, PAIR_S, interval(motion, end_s))
    motion.found(CAMERA_COVARIANCE)


def interval(motion: MotionFilter, end_s: float, period_s: float = PAIR_S) -> tuple[float, float]:
    """Return a step by the clock of the filter."""
    start_ns, end_ns = START_NS + round((end_s - period_s) * 1e9), START_NS + round(end_s * 1e9)
    return motion.sensors.seconds(start_ns), motion.sensors.seconds(end_ns)


def sensed(motion: MotionFilter, end_s: float, period_s: float = PAIR_S) -> tuple[Array, bool]:
    """Return the twist of a step that wheels and gyro measure, and whether they measure all of it."""
    T, is_complete = motion.step(interval(motion, end_s, period_s), period_s, 0.5)
    return se3.log(T), is_complete


WRONG = SensorErrors(1.03, 0.93, 0.018, -0.012, (0.01, -0.006, 0.015))


def test_errors_of_the_sensors_are_estimated() -> None:
    motion, _ = driven(WRONG, 40)
    error = motion.values - [1.03, 0.93, *WRONG.bias_radps]
    assert abs(error[DISTANCE]) < 0.003 and abs(error[TURN]) < 0.006
    assert np.abs(error[BIAS]).max() < 0.001
    assert motion.slips <= 2 and motion.refused <= 2


@pytest.mark.hazard("H14")
def test_slip_is_noticed_and_wheels_are_left_out_until_they_agree() -> None:
    motion, end_s = driven(SensorErrors(), 30)
    slips, rng = motion.slips, np.random.default_rng(3)
    slipping = SensorErrors(distance=1 / 1.2, turn=1 / 1.2)
    moving = 4 * np.pi * np.ceil(end_s / (4 * np.pi)) + 2.0  # the base drives at 0.33 m/s
    seen = []
    for k in range(12):
        end_s = moving + (k + 1) * PAIR_S
        motion.sensors.add(samples(slipping if k < 10 else SensorErrors(), end_s - PAIR_S, end_s, rng))
        observe(motion, end_s, rng)
        seen.append(motion.is_slipping)
    assert motion.slips - slips >= 9 and sum(seen[:10]) >= 9 and not seen[-1]
    assert abs(motion.values[DISTANCE] - 1) < 0.01


@pytest.mark.hazard("H14")
def test_wheels_with_wrong_settings_are_calibrated_again_and_refused_where_they_make_no_sense() -> None:
    motion, _ = driven(SensorErrors(distance=1.4), 60)
    assert abs(motion.values[DISTANCE] - 1.4) < 0.02 and motion.wheels_are_sane
    backwards, end_s = driven(SensorErrors(distance=-1.0), 60)
    assert not backwards.wheels_are_sane and not sensed(backwards, end_s)[1]


@pytest.mark.parametrize("late_s", [0.3, 1.0])
def test_no_motion_is_known_where_the_samples_leave_a_gap(late_s: float) -> None:
    motion, end_s = driven(SensorErrors(), 5)
    assert sensed(motion, end_s)[1] and not sensed(motion, end_s + late_s)[1]


def test_a_gyro_alone_knows_the_turn_and_not_the_distance() -> None:
    motion, end_s = driven(WRONG, 30, wheels=False)
    twist, is_complete = sensed(motion, end_s)
    truth = se3.log(T_RECT_BASE @ step(end_s - PAIR_S, end_s) @ se3.inverse(T_RECT_BASE))
    assert not is_complete and np.allclose(twist[3:], truth[3:], atol=2e-3)
    assert np.abs(motion.values[BIAS] - WRONG.bias_radps).max() < 0.001


@pytest.mark.hazard("H14")
def test_a_wheel_that_slips_in_the_dark_is_noticed_by_the_gyro() -> None:
    """The base goes straight on, one wheel turns faster: the distance is not to be believed either."""
    motion, end_s = driven(SensorErrors(), 30)
    rng, moving = np.random.default_rng(4), 4 * np.pi * np.ceil(end_s / (4 * np.pi)) + 2.0
    for seconds, slip in ((0.4, 0.0), (0.8, 0.15)):
        found = []
        for step_end in np.arange(moving + PAIR_S, moving + seconds, PAIR_S):
            new = samples(SensorErrors(), step_end - PAIR_S, step_end, rng)
            of_wheels = [one for one in new if isinstance(one, WheelSample)]
            motion.sensors.add([one for one in new if isinstance(one, GyroSample)])
            motion.sensors.add([replace(one, yaw_rate_radps=one.yaw_rate_radps + slip) for one in of_wheels])
            found.append(sensed(motion, step_end)[1])  # a single step may be a bump
        assert all(is_complete == (slip == 0) for is_complete in found[1:])
        moving += seconds


def test_a_jerk_leaves_open_whether_the_motion_goes_on_as_before() -> None:
    """A turn by 90 degrees within one step: the next one may be as before, or as this one, which two steps confirm."""
    motion, ahead = MotionFilter(), np.array([0.05, 0.0, 0.0, 0.0, 0.0, 0.0])
    jerk = ahead + np.array([0.0, 0.0, 0.0, 0.0, 0.0, np.pi / 2])

    def predicted(*steps: Array) -> tuple[Array, float]:
        for moved in steps:
            motion.step(None, PAIR_S, 0.5)
            motion.accept(se3.exp(moved), CAMERA_COVARIANCE, PAIR_S, None)
        T, _ = motion.step(None, PAIR_S, 0.5)
        return se3.log(T), PAIR_S * float(np.sqrt(motion.velocity_covariance[5, 5]))

    expected, sigma_rad = predicted(*[ahead] * 10)
    assert np.allclose(expected, ahead, atol=2e-3) and sigma_rad < 0.05
    expected, sigma_rad = predicted(jerk)
    assert np.abs(expected - ahead).max() < 2e-3 and sigma_rad > np.pi / 2
    expected, sigma_rad = predicted(jerk, jerk)
    assert np.abs(expected - jerk).max() < 0.1 and sigma_rad < 0.1


@pytest.mark.parametrize("of_gyro", [True, False])
@pytest.mark.parametrize("period_s", [0.1, 1 / 30])
def test_a_steady_turn_of_one_sensor_alone_is_noticed_before_clocks_are_learned(period_s: float, of_gyro: bool) -> None:
    """A base that is turned by hand, or wheels that turn on the spot: an offset of clocks does not explain it."""
    motion, times_s = MotionFilter(), np.arange(0.0, 3.0, GYRO_S)
    turns, none = np.where(times_s < 1.0, 0.0, 1.0), np.zeros_like(times_s)
    rates = (none, turns) if of_gyro else (turns, none)
    stamps_ns = [START_NS + round(t_s * 1e9) for t_s in times_s]
    motion.sensors.add([WheelSample(at, 0.2, rate) for at, rate in zip(stamps_ns, rates[0].tolist(), strict=True)])
    motion.sensors.add([GyroSample(at, 0.0, 0.0, rate) for at, rate in zip(stamps_ns, rates[1].tolist(), strict=True)])
    ends_s = np.arange(0.5, 2.9, period_s)
    trusted = np.array([sensed(motion, end_s, period_s)[1] for end_s in ends_s])
    assert trusted[ends_s < 1.0].all() and not trusted[ends_s > 1.0 + 3 * period_s].any()
