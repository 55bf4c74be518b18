"""The heading controller: on a unicycle, and with any numbers."""

from __future__ import annotations

import math
import random
from dataclasses import replace

import pytest

from omnid.core.control.heading_controller import (
    LONGEST_TICK_S,
    HeadingController,
    Setpoint,
    Twist,
    wrap_angle,
)

DT_S = 0.05
CONTROLLER = HeadingController()
LIMITS = CONTROLLER.limits
NOT_FINITE = (math.nan, math.inf, -math.inf)


def turn(
    setpoint: Setpoint, heading_rad: float, seconds: float, controller: HeadingController = CONTROLLER
) -> list[float]:
    """Return the unwrapped headings of a unicycle that starts from a stop; the measured ones are wrapped."""
    motion, headings = Twist(), [heading_rad]
    for _ in range(round(seconds / DT_S)):
        motion = controller.step(setpoint, wrap_angle(headings[-1]), DT_S, motion)
        headings.append(headings[-1] + motion.yaw_rate_radps * DT_S)
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
    controller = HeadingController(replace(LIMITS, gain_hz=gain_hz, yaw_acceleration_radps2=acceleration_radps2))
    headings = turn(Setpoint(0.0, 2.0), 0.0, 30.0, controller)
    assert headings[-1] == pytest.approx(2.0, abs=0.01)
    assert max(headings) < 2.1


def test_turns_on_although_noise_at_half_a_turn_changes_the_nearer_side() -> None:
    heading_rad, motion = 0.0, Twist()
    for i in range(12):
        measured = wrap_angle(heading_rad + (0.1 if i % 2 else -0.1))  # the nearer side changes with every step
        motion = CONTROLLER.step(Setpoint(0.0, math.pi), measured, DT_S, motion)
        heading_rad += motion.yaw_rate_radps * DT_S
    assert abs(motion.yaw_rate_radps) == LIMITS.yaw_rate_radps


@pytest.mark.parametrize(("error_rad", "side"), [(2.8, 1), (3.05, -1), (-2.8, -1), (-3.05, -1)])
def test_goes_on_to_the_side_it_turns_to_within_a_fifth_of_a_radian_of_half_a_turn(error_rad: float, side: int) -> None:
    motion = Twist(0.0, -0.9)
    for _ in range(20):
        motion = CONTROLLER.step(Setpoint(0.0, error_rad), 0.0, DT_S, motion)
    assert motion.yaw_rate_radps == side * LIMITS.yaw_rate_radps


def any_number(rng: random.Random) -> float:
    return rng.choice(
        [rng.uniform(-1, 1), rng.uniform(-10, 10), rng.gauss(0, 1e6), 0.0, 1e308, -1e308, 5e-324, *NOT_FINITE]
    )


def test_never_exceeds_its_limits() -> None:
    rng = random.Random(7)
    for _ in range(20_000):
        heading = None if rng.random() < 0.3 else any_number(rng)
        setpoint = Setpoint(any_number(rng), heading, any_number(rng))
        previous, dt_s = Twist(any_number(rng), any_number(rng)), any_number(rng)
        motion = CONTROLLER.step(setpoint, any_number(rng), dt_s, previous)
        assert abs(motion.velocity_mps) <= LIMITS.velocity_mps and abs(motion.yaw_rate_radps) <= LIMITS.yaw_rate_radps
        if all(map(math.isfinite, (dt_s, previous.velocity_mps, previous.yaw_rate_radps))):
            expect_bounded_change(previous, motion, min(max(dt_s, 0.0), LONGEST_TICK_S))
        else:
            assert motion == Twist()


def expect_bounded_change(previous: Twist, motion: Twist, dt_s: float) -> None:
    was_mps = max(-LIMITS.velocity_mps, min(LIMITS.velocity_mps, previous.velocity_mps))
    was_radps = max(-LIMITS.yaw_rate_radps, min(LIMITS.yaw_rate_radps, previous.yaw_rate_radps))
    assert abs(motion.velocity_mps - was_mps) <= LIMITS.acceleration_mps2 * dt_s + 1e-12
    assert abs(motion.yaw_rate_radps - was_radps) <= LIMITS.yaw_acceleration_radps2 * dt_s + 1e-12


@pytest.mark.parametrize("value", NOT_FINITE)
@pytest.mark.parametrize("place", ["velocity", "goal", "yaw rate", "heading"])
def test_slows_to_a_stop_where_an_input_is_not_finite(value: float, place: str) -> None:
    setpoint = Setpoint(
        value if place == "velocity" else 0.5, value if place == "goal" else 1.0, value if place == "yaw rate" else 0.0
    )
    motions = [Twist(0.5, -1.0)]
    for _ in range(40):
        motions.append(CONTROLLER.step(setpoint, value if place == "heading" else 0.0, DT_S, motions[-1]))
        assert abs(motions[-1].velocity_mps) <= abs(motions[-2].velocity_mps)
        assert abs(motions[-1].yaw_rate_radps) <= abs(motions[-2].yaw_rate_radps)
    assert motions[1] == Twist(0.475, -0.85) and motions[-1] == Twist()


@pytest.mark.parametrize("value", NOT_FINITE)
def test_stops_at_once_where_time_or_previous_motion_are_not_finite(value: float) -> None:
    setpoint = Setpoint(0.5, 1.0)
    assert CONTROLLER.step(setpoint, 0.0, value, Twist(0.5, 0.5)) == Twist()
    assert CONTROLLER.step(setpoint, 0.0, DT_S, Twist(value, 0.5)) == Twist()
    assert CONTROLLER.step(setpoint, 0.0, DT_S, Twist(0.5, value)) == Twist()


@pytest.mark.parametrize("angle_rad", [0.0, 3.0, -3.0, 4.0, -4.0, 100.0, 1e9])
def test_wrapped_angle_is_the_same_direction(angle_rad: float) -> None:
    wrapped = wrap_angle(angle_rad)
    assert -math.pi <= wrapped <= math.pi
    assert (math.cos(wrapped), math.sin(wrapped)) == pytest.approx((math.cos(angle_rad), math.sin(angle_rad)), abs=1e-6)
