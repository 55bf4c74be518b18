"""The law of motion: heading controller, limits of speed, and goals for motor controllers that hold headings."""

from __future__ import annotations

import math
import random
from dataclasses import replace

import pytest

from omnid.core.control.heading_controller import (
    LONGEST_TICK_S,
    STOP,
    HeadingController,
    HeadingGoal,
    HeadingLimits,
    Setpoint,
    Twist,
    VelocityLimits,
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


@pytest.mark.parametrize("wanted", [STOP, Twist(math.nan, 1.0), Twist(1.0, math.inf), Twist(-math.inf, 0.0)])
def test_stops_within_the_deceleration(wanted: Twist) -> None:
    sent, speeds = Twist(0.8, 1.0), [0.8]
    for _ in range(5):
        sent = OF_WHEELS.step(wanted, sent, 0.1)
        speeds.append(sent.velocity_mps)
    assert sent == STOP and speeds[:5] == pytest.approx([0.8, 0.6, 0.4, 0.2, 0.0])


def integrated(wanted: Twist, last: Twist, dt_s: float, steps: int = 2000) -> Twist:
    """Return the motion after a time by small steps, each of which may brake, or speed up, or turn faster by a part."""
    step_s, v, w = dt_s / steps, last.velocity_mps, last.yaw_rate_radps
    goal_mps, goal_radps = max(-0.8, min(0.8, wanted.velocity_mps)), max(-1.5, min(1.5, wanted.yaw_rate_radps))
    for _ in range(steps):
        brakes = v * goal_mps < 0.0 or abs(goal_mps) < abs(v)
        change = (2.0 if brakes else 0.5) * step_s
        v = goal_mps if abs(goal_mps - v) <= change else v + math.copysign(change, goal_mps - v)
        turn = 3.0 * step_s
        w = goal_radps if abs(goal_radps - w) <= turn else w + math.copysign(turn, goal_radps - w)
    return Twist(v, w)


def test_is_as_fast_as_the_limits_allow_by_small_steps() -> None:
    rng = random.Random(6)
    for _ in range(250):
        last, dt_s = Twist(rng.uniform(-0.8, 0.8), rng.uniform(-1.5, 1.5)), rng.uniform(0.0, LONGEST_TICK_S)
        wanted = Twist(rng.choice((0.0, rng.uniform(-0.3, 0.3), rng.uniform(-1, 1))), rng.uniform(-2, 2))
        sent, expected = OF_WHEELS.step(wanted, last, dt_s), integrated(wanted, last, dt_s)
        assert sent.velocity_mps == pytest.approx(expected.velocity_mps, abs=1e-3), (wanted, last, dt_s)
        assert sent.yaw_rate_radps == pytest.approx(expected.yaw_rate_radps, abs=1e-3)


def test_a_late_tick_allows_no_larger_step_than_one_of_a_fifth_of_a_second() -> None:
    assert OF_WHEELS.step(Twist(0.8, 1.5), STOP, 9.0) == Twist(pytest.approx(0.1), pytest.approx(0.6))


HEADING = HeadingLimits(yaw_rate_radps=0.8, yaw_acceleration_radps2=4.0)
OF_HOLDER = VelocityLimits(yaw_rate_radps=1.2, yaw_acceleration_radps2=2.0)
LONGEST_RAD = 0.15 * 0.8 + 0.8**2 / (2 * 2)


@pytest.fixture
def goal() -> HeadingGoal:
    return HeadingGoal(HEADING, OF_HOLDER)


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
