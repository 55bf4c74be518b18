"""The heading hold: on a unicycle, and under any numbers."""

from __future__ import annotations

import math
import random
from dataclasses import replace

import pytest

from omnid.core.control.heading_controller import (
    LONGEST_TICK_S,
    HeadingController,
    HeadingLimits,
    Setpoint,
    Twist,
    wrap_angle,
)
from omnid.errors import OmnidError

DT_S = 0.05
HOLD = HeadingController()
LIMITS = HOLD.limits
ODD = (math.nan, math.inf, -math.inf)


def turn(setpoint: Setpoint, heading_rad: float, seconds: float, hold: HeadingController = HOLD) -> list[float]:
    """The unwrapped headings of a unicycle under the hold; measured wrapped, from standstill."""
    drive, headings = Twist(), [heading_rad]
    for _ in range(round(seconds / DT_S)):
        drive = hold.step(setpoint, wrap_angle(headings[-1]), DT_S, drive)
        headings.append(headings[-1] + drive.yaw_rate_radps * DT_S)
    return headings


@pytest.mark.parametrize("start_rad", [0.0, 1.0, -3.0, 3.1, math.pi])
@pytest.mark.parametrize("goal_rad", [0.0, 0.5, -1.5, 3.0, -3.0, math.pi, 7.0])
def test_reaches_the_heading_the_short_way_without_overshoot(start_rad: float, goal_rad: float) -> None:
    headings = turn(Setpoint(0.3, goal_rad), start_rad, 12.0)
    way_rad = wrap_angle(goal_rad - start_rad)
    turned = [abs(heading - start_rad) for heading in headings]
    assert abs(wrap_angle(headings[-1] - goal_rad)) < 1e-3
    assert max(turned) <= abs(way_rad) + 0.005


@pytest.mark.parametrize("gain_hz", [0.3, 1.5, 5.0])
@pytest.mark.parametrize("acceleration_radps2", [0.3, 3.0, 30.0])
def test_settles_with_any_sensible_gain(gain_hz: float, acceleration_radps2: float) -> None:
    hold = HeadingController(replace(LIMITS, gain_hz=gain_hz, yaw_acceleration_radps2=acceleration_radps2))
    headings = turn(Setpoint(0.0, 2.0), 0.0, 30.0, hold)
    assert headings[-1] == pytest.approx(2.0, abs=0.01)
    assert max(headings) < 2.1


def test_noise_at_half_a_turn_does_not_hold_it_there() -> None:
    heading_rad, drive = 0.0, Twist()
    for i in range(12):
        measured = wrap_angle(heading_rad + (0.1 if i % 2 else -0.1))  # now this side is nearer, now that
        drive = HOLD.step(Setpoint(0.0, math.pi), measured, DT_S, drive)
        heading_rad += drive.yaw_rate_radps * DT_S
    assert abs(drive.yaw_rate_radps) == LIMITS.yaw_rate_radps


def any_number(rng: random.Random) -> float:
    return rng.choice(
        [rng.uniform(-1, 1), rng.uniform(-10, 10), rng.gauss(0, 1e6), 0.0, 1e308, -1e308, 5e-324, *ODD]
    )


def test_never_leaves_its_limits_whatever_comes() -> None:
    rng = random.Random(7)
    for _ in range(20_000):
        heading = None if rng.random() < 0.3 else any_number(rng)
        setpoint = Setpoint(any_number(rng), heading, any_number(rng))
        previous, dt_s = Twist(any_number(rng), any_number(rng)), any_number(rng)
        drive = HOLD.step(setpoint, any_number(rng), dt_s, previous)
        assert abs(drive.velocity_mps) <= LIMITS.velocity_mps and abs(drive.yaw_rate_radps) <= LIMITS.yaw_rate_radps
        if all(map(math.isfinite, (dt_s, previous.velocity_mps, previous.yaw_rate_radps))):
            expect_bounded_change(previous, drive, min(max(dt_s, 0.0), LONGEST_TICK_S))
        else:
            assert drive == Twist()


def expect_bounded_change(previous: Twist, drive: Twist, dt_s: float) -> None:
    was_mps = max(-LIMITS.velocity_mps, min(LIMITS.velocity_mps, previous.velocity_mps))
    was_radps = max(-LIMITS.yaw_rate_radps, min(LIMITS.yaw_rate_radps, previous.yaw_rate_radps))
    assert abs(drive.velocity_mps - was_mps) <= LIMITS.acceleration_mps2 * dt_s + 1e-12
    assert abs(drive.yaw_rate_radps - was_radps) <= LIMITS.yaw_acceleration_radps2 * dt_s + 1e-12


@pytest.mark.parametrize("odd", ODD)
@pytest.mark.parametrize("place", ["velocity", "goal", "yaw rate", "heading"])
def test_slows_to_a_stop_on_what_is_not_finite(odd: float, place: str) -> None:
    setpoint = Setpoint(
        odd if place == "velocity" else 0.5, odd if place == "goal" else 1.0, odd if place == "yaw rate" else 0.0
    )
    drives = [Twist(0.5, -1.0)]
    for _ in range(40):
        drives.append(HOLD.step(setpoint, odd if place == "heading" else 0.0, DT_S, drives[-1]))
        assert abs(drives[-1].velocity_mps) <= abs(drives[-2].velocity_mps)
        assert abs(drives[-1].yaw_rate_radps) <= abs(drives[-2].yaw_rate_radps)
    assert drives[1] == Twist(0.475, -0.85) and drives[-1] == Twist()


@pytest.mark.parametrize("odd", ODD)
def test_stands_still_at_once_without_a_known_past(odd: float) -> None:
    setpoint = Setpoint(0.5, 1.0)
    assert HOLD.step(setpoint, 0.0, odd, Twist(0.5, 0.5)) == Twist()
    assert HOLD.step(setpoint, 0.0, DT_S, Twist(odd, 0.5)) == Twist()
    assert HOLD.step(setpoint, 0.0, DT_S, Twist(0.5, odd)) == Twist()


def test_no_time_no_change() -> None:
    for dt_s in (0.0, -1.0):
        assert HOLD.step(Setpoint(-0.5, 3.0), 0.0, dt_s, Twist(0.2, 0.1)) == Twist(0.2, 0.1)


def test_without_a_heading_the_yaw_rate_is_followed() -> None:
    drive = Twist()
    for _ in range(60):
        drive = HOLD.step(Setpoint(-0.2, None, 0.7), 1.0, DT_S, drive)
    assert (drive.velocity_mps, drive.yaw_rate_radps) == pytest.approx((-0.2, 0.7))


@pytest.mark.parametrize("angle_rad", [0.0, 3.0, -3.0, 4.0, -4.0, 100.0, 1e9])
def test_wrapped_angle_is_the_same_direction(angle_rad: float) -> None:
    wrapped = wrap_angle(angle_rad)
    assert -math.pi <= wrapped <= math.pi
    assert (math.cos(wrapped), math.sin(wrapped)) == pytest.approx((math.cos(angle_rad), math.sin(angle_rad)), abs=1e-6)


def test_wrapping_what_is_not_finite_is_nan() -> None:
    assert all(math.isnan(wrap_angle(odd)) for odd in ODD)


@pytest.mark.parametrize("bad", [0.0, -1.0, *ODD])
def test_limits_must_be_above_zero(bad: float) -> None:
    with pytest.raises(OmnidError, match="gain_hz"):
        HeadingLimits(gain_hz=bad)


def test_huge_headings_are_directions_too() -> None:
    drive = HOLD.step(Setpoint(0.0, 1e308), -1e308, LONGEST_TICK_S, Twist())
    error_rad = wrap_angle(wrap_angle(1e308) - wrap_angle(-1e308))
    assert math.copysign(1.0, drive.yaw_rate_radps) == math.copysign(1.0, error_rad) and abs(error_rad) < 2.9
