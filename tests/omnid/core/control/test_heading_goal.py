"""Goals for motor controllers that hold headings: within the limits of the yaw rate, whatever is asked."""

from __future__ import annotations

import math
import random

import pytest

from omnid.core.control.heading_controller import (
    HeadingGoal,
    HeadingLimits,
    VelocityLimits,
    wrap_angle,
)

HEADING = HeadingLimits(yaw_rate_radps=0.8, yaw_acceleration_radps2=4.0)
LIMITS = VelocityLimits(yaw_rate_radps=1.2, yaw_acceleration_radps2=2.0)
LONGEST_RAD = 0.15 * 0.8 + 0.8**2 / (2 * 2)


@pytest.fixture
def goal() -> HeadingGoal:
    return HeadingGoal(HEADING, LIMITS)


@pytest.mark.hazard("H11")
def test_a_blocked_base_gets_no_goal_beyond_the_longest_lead(goal: HeadingGoal) -> None:
    goal.update(2.0, 0.0)
    for error_rad in (None, 3.0):
        goals = [goal.towards(0.05, error_rad) for _ in range(100)]
        assert goals[0] == pytest.approx(2.05) and goals[-1] == pytest.approx(2.0 + LONGEST_RAD)
        goal.stay()
    assert [goal.towards(-0.05, -3.0) for _ in range(100)][-1] == pytest.approx(2.0 - LONGEST_RAD)


def test_a_goal_moves_by_no_more_than_the_turn(goal: HeadingGoal) -> None:
    """However far the wanted heading is, and wherever it jumps to."""
    rng, before_rad = random.Random(1), 0.0
    for _ in range(500):
        goal.update(before_rad, 0.0)
        turn_rad, error_rad = rng.uniform(-0.05, 0.05), rng.uniform(-3.1, 3.1)
        after_rad = goal.towards(turn_rad, error_rad if abs(error_rad) > LONGEST_RAD else None)
        assert abs(wrap_angle(after_rad - before_rad)) <= abs(turn_rad) + 1e-12
        before_rad = after_rad


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


def test_numbers_that_are_not_finite_leave_the_goal_at_the_heading(goal: HeadingGoal) -> None:
    goal.update(1.0, math.nan)
    goal.update(math.nan, math.inf)
    for turn_rad, error_rad in ((math.nan, None), (0.1, math.nan), (math.inf, 0.1)):
        assert goal.towards(turn_rad, error_rad) == 1.0
    assert goal.towards(0.1) == pytest.approx(1.1)
