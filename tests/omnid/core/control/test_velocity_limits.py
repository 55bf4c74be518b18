"""The velocity limits: no sequence of inputs gives a command beyond them."""

from __future__ import annotations

import math
import random

import pytest

from omnid.core.control.heading_controller import LONGEST_TICK_S, STOP, Twist, VelocityLimits

LIMITS = VelocityLimits(velocity_mps=0.8, acceleration_mps2=0.5, deceleration_mps2=2.0, yaw_rate_radps=1.5,
                       yaw_acceleration_radps2=3.0)  # fmt: skip
EXTREMES = (0.0, -0.0, math.nan, math.inf, -math.inf, 1e300, -1e300, 5e-324, 1e-9)
SLACK = 1 + 1e-9


def any_number(rng: random.Random) -> float:
    return rng.choice(EXTREMES) if rng.random() < 0.3 else rng.gauss(0.0, rng.choice([0.1, 1.0, 10.0]))


@pytest.mark.hazard("H10")
@pytest.mark.parametrize("seed", range(5))
def test_never_exceeds_a_limit(seed: int) -> None:
    rng, sent = random.Random(seed), STOP
    for _ in range(5000):
        wanted = Twist(any_number(rng), any_number(rng))
        dt_s = abs(rng.gauss(0.05, 0.05)) if rng.random() < 0.8 else any_number(rng)
        last, sent = sent, LIMITS.step(wanted, sent, dt_s)
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
        sent = LIMITS.step(*(Twist(any_number(rng), any_number(rng)) for _ in range(2)), any_number(rng))
        assert abs(sent.velocity_mps) <= 0.8 and abs(sent.yaw_rate_radps) <= 1.5


@pytest.mark.parametrize("wanted", [STOP, Twist(math.nan, 1.0), Twist(1.0, math.inf), Twist(-math.inf, 0.0)])
def test_stops_within_the_deceleration(wanted: Twist) -> None:
    sent, speeds = Twist(0.8, 1.0), [0.8]
    for _ in range(5):
        sent = LIMITS.step(wanted, sent, 0.1)
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
        sent, expected = LIMITS.step(wanted, last, dt_s), integrated(wanted, last, dt_s)
        assert sent.velocity_mps == pytest.approx(expected.velocity_mps, abs=1e-3), (wanted, last, dt_s)
        assert sent.yaw_rate_radps == pytest.approx(expected.yaw_rate_radps, abs=1e-3)


def test_a_late_tick_allows_no_larger_step_than_one_of_a_fifth_of_a_second() -> None:
    assert LIMITS.step(Twist(0.8, 1.5), STOP, 9.0) == Twist(pytest.approx(0.1), pytest.approx(0.6))
