"""Wheels and gyro with errors that are known: the estimates, their uncertainty, slip, standstill, gaps."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import pytest
from numpy.typing import NDArray

from calib import se3
from drivers.motion import GyroSample, MotionSample, WheelSample
from omnid.core.odometry.motion_sensors import (
    BIAS,
    DISTANCE,
    GYRO_OFFSET,
    TURN,
    WHEEL_OFFSET,
    MotionSensors,
    SensedMotion,
)

Array = NDArray[np.float64]

T_RECT_BASE = se3.exp([0.1, -0.05, -0.4, 0.02, -0.01, 0.7])
PAIR_S, WHEEL_S, GYRO_S = 0.1, 0.02, 0.01
CAMERA_COVARIANCE = np.diag(np.repeat([1e-4, 5e-5], 3) ** 2)
START_NS = 1_795_000_000_000_000_000


@dataclass(frozen=True)
class SensorErrors:
    """Errors of the sensors."""

    distance: float = 1.0  # metres of the base per metre of the wheels
    turn: float = 1.0
    wheel_offset_s: float = 0.0  # to be added to the stamps
    gyro_offset_s: float = 0.0
    bias_radps: tuple[float, float, float] = (0.0, 0.0, 0.0)
    noise: float = 1.0  # of the ordinary noise


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
                speed / errors.distance + errors.noise * rng.normal(0, 0.002),
                rate / errors.turn + errors.noise * rng.normal(0, 0.004),
            )
        )
    times_s = np.arange(start_s, end_s - 1e-9, GYRO_S)
    for t_s, turn in zip(times_s, velocity(times_s)[1], strict=True):
        rates = np.array([0, 0, turn]) + errors.bias_radps + errors.noise * rng.normal(0, 0.003, 3)
        found.append(GyroSample(START_NS + round((t_s - errors.gyro_offset_s) * 1e9), *rates))
    return found


def driven(errors: SensorErrors, seconds: float, seed: int = 1, wheels: bool = True) -> tuple[MotionSensors, float]:
    """Return the sensors after a drive with cameras that measure each step, and its end."""
    rng, sensors = np.random.default_rng(seed), MotionSensors(T_RECT_BASE)
    end_s = 0.0
    for end_s in np.arange(PAIR_S, seconds, PAIR_S):
        new = samples(errors, end_s - PAIR_S, end_s, rng)
        sensors.add([sample for sample in new if wheels or isinstance(sample, GyroSample)])
        T = T_RECT_BASE @ step(end_s - PAIR_S, end_s) @ se3.inverse(T_RECT_BASE)
        T = T @ se3.exp(rng.multivariate_normal(np.zeros(6), CAMERA_COVARIANCE))
        sensors.observe(T, CAMERA_COVARIANCE, *stamps(end_s))
    return sensors, float(end_s)


def stamps(end_s: float) -> tuple[int, int]:
    """Return the stamps of a step."""
    return START_NS + round((end_s - PAIR_S) * 1e9), START_NS + round(end_s * 1e9)


WRONG = SensorErrors(1.03, 0.93, 0.018, -0.012, (0.01, -0.006, 0.015))


def test_errors_of_the_sensors_are_estimated_with_their_uncertainty() -> None:
    sensors, _ = driven(WRONG, 40)
    truth = np.array([1.03, 0.93, 0.018, -0.012, *WRONG.bias_radps])
    error = sensors.values - truth
    assert abs(error[DISTANCE]) < 0.003 and abs(error[TURN]) < 0.006
    assert abs(error[WHEEL_OFFSET]) < 0.004 and abs(error[GYRO_OFFSET]) < 0.003
    assert np.abs(error[BIAS]).max() < 0.001
    assert (np.abs(error) < 4 * sensors.sigmas).all() and (sensors.sigmas < 0.01).all()
    assert sensors.slips <= 2 and sensors.refused <= 2


@pytest.mark.hazard("H14")
def test_slip_is_noticed_and_wheels_are_left_out_until_they_agree() -> None:
    sensors, end_s = driven(SensorErrors(), 30)
    slips, rng = sensors.slips, np.random.default_rng(3)
    slipping = SensorErrors(distance=1 / 1.2, turn=1 / 1.2)
    moving = 4 * np.pi * round(end_s / (4 * np.pi)) + 2.0  # the base drives at 0.33 m/s
    seen = []
    for k in range(12):
        end_s = moving + (k + 1) * PAIR_S
        sensors.add(samples(slipping if k < 10 else SensorErrors(), end_s - PAIR_S, end_s, rng))
        T = T_RECT_BASE @ step(end_s - PAIR_S, end_s) @ se3.inverse(T_RECT_BASE)
        sensors.observe(T, CAMERA_COVARIANCE, *stamps(end_s))
        seen.append(sensors.is_slipping)
    assert sensors.slips - slips >= 9 and sum(seen[:10]) >= 9 and not seen[-1]
    assert abs(sensors.values[DISTANCE] - 1) < 0.01


@pytest.mark.hazard("H14")
def test_wheels_with_wrong_settings_are_calibrated_again_and_refused_where_they_make_no_sense() -> None:
    sensors, _ = driven(SensorErrors(distance=1.4), 60)
    assert abs(sensors.values[DISTANCE] - 1.4) < 0.02 and sensors.wheels_are_sane
    backwards, end_s = driven(SensorErrors(distance=-1.0), 60)
    assert not backwards.wheels_are_sane
    sensed = backwards.between(*stamps(end_s))
    assert sensed is not None and not sensed.is_complete


def test_a_base_that_stands_does_not_move_at_all() -> None:
    sensors, _ = driven(replace(WRONG, noise=0.3), 30)
    rng, end_s = np.random.default_rng(9), 12 * np.pi + 2 * np.pi + 0.5  # velocity(t) is 0 for the next six seconds
    sensed: SensedMotion | None = None
    for _ in range(10):
        end_s += PAIR_S
        sensors.add(samples(replace(WRONG, noise=0.3), end_s - PAIR_S, end_s, rng))
        sensed = sensors.between(*stamps(end_s - 0.02))
    assert sensed is not None and (sensed.twist == 0).all() and sensed.is_complete
    assert np.sqrt(np.diag(sensed.covariance)).max() < 5e-4


@pytest.mark.parametrize("late_s", [0.3, 1.0])
def test_no_motion_is_known_where_the_samples_leave_a_gap(late_s: float) -> None:
    sensors, end_s = driven(SensorErrors(), 5)
    assert sensors.between(*stamps(end_s)) is not None
    assert sensors.between(*stamps(end_s + late_s)) is None


def test_a_gyro_alone_knows_the_turn_and_not_the_distance() -> None:
    sensors, end_s = driven(WRONG, 30, wheels=False)
    sensed = sensors.between(*stamps(end_s))
    truth = se3.log(T_RECT_BASE @ step(end_s - PAIR_S, end_s) @ se3.inverse(T_RECT_BASE))
    assert sensed is not None and not sensed.is_complete
    assert np.allclose(sensed.twist[3:], truth[3:], atol=2e-3)
    assert np.abs(sensors.values[BIAS] - WRONG.bias_radps).max() < 0.001


def test_late_samples_and_any_order_give_the_same_motion() -> None:
    rng = np.random.default_rng(2)
    new = samples(SensorErrors(), 0.0, 1.0, rng)
    ordered, mixed = MotionSensors(T_RECT_BASE), MotionSensors(T_RECT_BASE)
    ordered.add(new)
    for part in (new[1::2], new[::2]):
        mixed.add(list(rng.permutation(np.array(part, object))))
    one, other = ordered.between(*stamps(0.9)), mixed.between(*stamps(0.9))
    assert one is not None and other is not None
    assert np.allclose(one.twist, other.twist, atol=1e-12)


@pytest.mark.hazard("H14")
def test_a_wheel_that_slips_in_the_dark_is_noticed_by_the_gyro() -> None:
    """The base goes straight on, one wheel turns faster: the distance is not to be believed either."""
    sensors, end_s = driven(SensorErrors(), 30)
    rng, moving = np.random.default_rng(4), 4 * np.pi * round(end_s / (4 * np.pi)) + 2.0
    for seconds, slip in ((0.4, 0.0), (0.8, 0.15)):
        found = []
        for step_end in np.arange(moving + PAIR_S, moving + seconds, PAIR_S):
            new = samples(SensorErrors(), step_end - PAIR_S, step_end, rng)
            sensors.add(
                [
                    replace(sample, yaw_rate_radps=sample.yaw_rate_radps + slip)
                    if isinstance(sample, WheelSample)
                    else sample
                    for sample in new
                ]
            )
            found.append(sensors.between(*stamps(step_end)))  # a single step may be a bump
        assert all(sensed is not None and sensed.is_complete == (slip == 0) for sensed in found[1:])
        moving += seconds


@pytest.mark.parametrize("of_gyro", [True, False])
@pytest.mark.parametrize("period_s", [0.1, 1 / 30])
def test_a_steady_turn_of_one_sensor_alone_is_noticed_before_clocks_are_learned(period_s: float, of_gyro: bool) -> None:
    """A base that is turned by hand, or wheels that turn on the spot: an offset of clocks does not explain it."""
    sensors = MotionSensors(T_RECT_BASE)
    times_s = np.arange(0.0, 3.0, GYRO_S)
    turns, of_wheels = np.where(times_s < 1.0, 0.0, 1.0), np.zeros_like(times_s)
    rates = (of_wheels, turns) if of_gyro else (turns, of_wheels)
    stamps_ns = [START_NS + round(t_s * 1e9) for t_s in times_s]
    sensors.add([WheelSample(at, 0.2, rate) for at, rate in zip(stamps_ns, rates[0].tolist(), strict=True)])
    sensors.add([GyroSample(at, 0.0, 0.0, rate) for at, rate in zip(stamps_ns, rates[1].tolist(), strict=True)])
    ends_s = np.arange(0.5, 2.9, period_s)
    found = [
        sensors.between(START_NS + round((end_s - period_s) * 1e9), START_NS + round(end_s * 1e9)) for end_s in ends_s
    ]
    trusted = np.array([one is not None and one.is_complete for one in found])
    assert trusted[ends_s < 1.0].all() and not trusted[ends_s > 1.0 + 3 * period_s].any()


def test_wheels_that_do_not_tell_their_turn_need_a_gyro() -> None:
    """As those of controllers that hold a heading by themselves."""
    for gyro in (True, False):
        rng, sensors = np.random.default_rng(4), MotionSensors(T_RECT_BASE)
        new = samples(SensorErrors(), 0.0, 2.0, rng)
        sensors.add(
            [
                replace(sample, yaw_rate_radps=np.nan) if isinstance(sample, WheelSample) else sample
                for sample in new
                if gyro or isinstance(sample, WheelSample)
            ]
        )
        sensed = sensors.between(*stamps(1.5))
        assert sensed is not None and np.isfinite(sensed.twist).all() and np.isfinite(sensed.covariance).all()
        assert sensed.is_complete == gyro


def test_rough_wheels_do_not_count_as_slipping() -> None:
    """Ten times the noise of the other tests: after some seconds it is known, and the covariance says so."""
    calm, _ = driven(SensorErrors(), 20)
    rough, end_s = driven(SensorErrors(noise=10.0), 20, wheels=True)
    before = rough.slips
    rng = np.random.default_rng(8)
    for _ in range(60):
        end_s += PAIR_S
        rough.add(samples(SensorErrors(noise=10.0), end_s - PAIR_S, end_s, rng))
        T = T_RECT_BASE @ step(end_s - PAIR_S, end_s) @ se3.inverse(T_RECT_BASE)
        rough.observe(T, CAMERA_COVARIANCE, *stamps(end_s))
    assert rough.slips - before <= 2
    sensed, quiet = rough.between(*stamps(end_s)), calm.between(*stamps(19.9))
    assert sensed is not None and quiet is not None
    assert np.trace(sensed.noise[:3, :3]) > 2.5 * np.trace(quiet.noise[:3, :3])
