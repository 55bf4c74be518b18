"""The law of motion: heading controller, limits of speed, and goals for motor controllers that hold headings."""

from __future__ import annotations

import math
import random

import pytest

from omnid.core.control.heading_controller import (
    LONGEST_TICK_S,
    STOP,
    HeadingGoal,
    Setpoint,
    Twist,
    VelocityLimits,
    towards,
    wrap_angle,
)

DT_S = 0.05
LIMITS = VelocityLimits()
NOT_FINITE = (math.nan, math.inf, -math.inf)


def step(setpoint: Setpoint, heading_rad: float, last: Twist) -> Twist:
    return LIMITS.step(towards(setpoint, heading_rad, last, LIMITS), last, DT_S)


def turn(setpoint: Setpoint, heading_rad: float, seconds: float) -> list[float]:
    """Return the unwrapped headings of a unicycle that starts from a stop; the measured ones are wrapped."""
    motion, headings = Twist(), [heading_rad]
    for _ in range(round(seconds / DT_S)):
        motion = step(setpoint, wrap_angle(headings[-1]), motion)
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


def test_turns_on_although_noise_at_half_a_turn_changes_the_nearer_side() -> None:
    heading_rad, motion = 0.0, Twist()
    for i in range(12):
        measured = wrap_angle(heading_rad + (0.1 if i % 2 else -0.1))  # the nearer side changes with every step
        motion = step(Setpoint(0.0, math.pi), measured, motion)
        heading_rad += motion.yaw_rate_radps * DT_S
    assert abs(motion.yaw_rate_radps) == LIMITS.yaw_rate_radps


@pytest.mark.parametrize("value", NOT_FINITE)
@pytest.mark.parametrize("place", ["velocity", "goal", "yaw rate", "heading"])
def test_slows_to_a_stop_where_an_input_is_not_finite(value: float, place: str) -> None:
    setpoint = Setpoint(
        value if place == "velocity" else 0.5, value if place == "goal" else 1.0, value if place == "yaw rate" else 0.0
    )
    motions = [Twist(0.5, -1.0)]
    for _ in range(40):
        motions.append(step(setpoint, value if place == "heading" else 0.0, motions[-1]))
        assert abs(motions[-1].velocity_mps) <= abs(motions[-2].velocity_mps)
        assert abs(motions[-1].yaw_rate_radps) <= abs(motions[-2].yaw_rate_radps)
    assert motions[1] == Twist(0.425, -0.85) and motions[-1] == Twist()


OF_WHEELS = VelocityLimits(velocity_mps=0.8, acceleration_mps2=0.5, deceleration_mps2=2.0, yaw_rate_radps=1.5,
                       yaw_acceleration_radps2=3.0)  # fmt: skip
EXTREMES = (0.0, -0.0, math.nan, math.inf, -math.inf, 1e300, -1e300, 5e-324, 1e-9)
SLACK = 1 + 1e-9


def any_speed(rng: random.Random) -> float:
    return rng.choice(EXTREMES) if rng.random() < 0.3 else rng.gauss(0.0, rng.choice([0.1, 1.0, 10.0]))


@pytest.mark.hazard("H10")
@pytest.mark.parametrize("seed", range(5))
def test_never_exceeds_a_limit(seed: int) -> None:
    rng, sent = random.Random(seed), STOP
    for _ in range(5000):
        wanted = Twist(any_speed(rng), any_speed(rng))
        dt_s = abs(rng.gauss(0.05, 0.05)) if rng.random() < 0.8 else any_speed(rng)
        last, sent = sent, OF_WHEELS.step(wanted, sent, dt_s)
        assert_within(last, sent, dt_s)


def assert_within(last: Twist, sent: Twist, dt_s: float) -> None:
    passed_s = min(max(dt_s, 0.0), LONGEST_TICK_S) if math.isfinite(dt_s) else 0.0
    tiny = 1e-12
    assert abs(sent.velocity_mps) <= 0.8 and abs(sent.yaw_rate_radps) <= 1.5
    assert abs(sent.yaw_rate_radps - last.yaw_rate_radps) <= 3.0 * passed_s * SLACK + tiny
    gained_mps = abs(sent.velocity_mps) - abs(last.velocity_mps)
    assert gained_mps <= 0.5 * passed_s * SLACK + tiny
    assert abs(sent.velocity_mps - last.velocity_mps) <= 2.0 * passed_s * SLACK + tiny
    if sent.velocity_mps * last.velocity_mps < 0:  # across zero: the part beyond it is an acceleration
        braking_s = abs(last.velocity_mps) / 2.0
        assert abs(sent.velocity_mps) <= 0.5 * (passed_s - braking_s) * SLACK + tiny


@pytest.mark.hazard("H10")
@pytest.mark.parametrize("seed", range(3))
def test_is_finite_and_bounded_after_any_previous_motion(seed: int) -> None:
    rng = random.Random(seed)
    for _ in range(3000):
        sent = OF_WHEELS.step(*(Twist(any_speed(rng), any_speed(rng)) for _ in range(2)), any_speed(rng))
        assert abs(sent.velocity_mps) <= 0.8 and abs(sent.yaw_rate_radps) <= 1.5


OF_HOLDER = VelocityLimits(yaw_rate_radps=0.8, yaw_acceleration_radps2=2.0)
LONGEST_RAD = 0.15 * 0.8 + 0.8**2 / (2 * 2)


@pytest.fixture
def goal() -> HeadingGoal:
    return HeadingGoal(OF_HOLDER)


@pytest.mark.hazard("H11")
def test_a_blocked_base_gets_no_goal_beyond_the_longest_lead(goal: HeadingGoal) -> None:
    goal.update(2.0, 0.0)
    for error_rad in (None, 3.0):
        goals = [goal.towards(0.05, error_rad) for _ in range(100)]
        assert goals[0] == pytest.approx(2.05) and goals[-1] == pytest.approx(2.0 + LONGEST_RAD)
        goal.stay()
    assert [goal.towards(-0.05, -3.0) for _ in range(100)][-1] == pytest.approx(2.0 - LONGEST_RAD)


def test_the_goal_does_not_pass_the_wanted_heading(goal: HeadingGoal) -> None:
    goal.update(1.0, 0.5)
    for error_rad, turn_rad, expected_rad in ((0.1, 0.5, 1.1), (-0.1, -0.5, 0.9), (0.1, -0.5, 1.0), (0.0, 0.5, 1.0)):
        goal.stay()
        assert goal.towards(turn_rad, error_rad) == pytest.approx(expected_rad)


def test_a_base_that_turns_too_fast_is_to_hold_its_heading(goal: HeadingGoal) -> None:
    goal.update(0.0, 0.87)
    assert goal.towards(0.2) == pytest.approx(0.2), "a little more than the limit is lag"
    for rate_radps, turn_rad, expected_rad in ((0.89, 0.2, 0.0), (-0.89, -0.2, 0.0), (-1.2, 0.2, 0.2)):
        goal.stay()
        goal.update(0.0, rate_radps)
        assert goal.towards(turn_rad) == pytest.approx(expected_rad)
