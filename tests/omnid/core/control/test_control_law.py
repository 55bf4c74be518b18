"""The control law as a whole: what its parts have to be told at each step."""

from __future__ import annotations

import math
import random
from dataclasses import replace
from itertools import combinations

import pytest

from omnid.core.control import safety_rules
from omnid.core.control.arming import (
    AUTOMATIC,
    LOWER_PRIORITY,
    MANUAL,
    OPERATOR,
    OTHER_SENDER,
    PLANNER,
    CommandSelector,
    TimedSetpoint,
)
from omnid.core.control.collision_monitor import CollisionSettings, ControllerScan
from omnid.core.control.control_law import ControlLaw, ControllerPose, ControllerSettings
from omnid.core.control.heading_controller import (
    LONGEST_TICK_S,
    STOP,
    Setpoint,
    Twist,
    VelocityLimits,
    towards,
    wrap_angle,
)
from omnid.core.control.motion_monitor import NOT_SEEN
from omnid.core.control.safety_rules import (
    ASKED,
    AWAITED,
    BUMPER,
    CLIFF,
    COMMAND_STALE,
    ENDS,
    IDLE,
    NO_POSE,
    NOT_ARMED,
    OVERLOADED,
    POSE_JUMPED,
    POSE_STALE,
    Deadlines,
    stop_reason,
)

TICK_NS, TICK_S = 20_000_000, 0.02
START_NS = 10**12
WALL_M = 1.0
WALL = tuple(WALL_M / math.cos(math.radians(k - 179.5)) if abs(k - 179.5) < 40 else math.inf for k in range(360))


def test_the_way_since_the_images_of_the_scan_counts() -> None:
    """One scan, a wall 1 m ahead: the base stops before the wall by its own motion, without another scan."""
    collision = CollisionSettings(stale_s=10.0)
    law = ControlLaw(ControllerSettings(arming=AUTOMATIC, collision=collision), START_NS)
    law.take(ControllerScan(START_NS, WALL))
    driven_m = fastest_mps = 0.0
    for tick in range(1, 400):
        now_ns = START_NS + tick * TICK_NS
        law.take(ControllerPose(now_ns, 0.0, 0.0, "tracking", law.motion.velocity_mps))
        law.take(TimedSetpoint(now_ns, Setpoint(0.5)))
        driven_m += law.step(now_ns, TICK_S).motion.velocity_mps * TICK_S
        fastest_mps = max(fastest_mps, law.motion.velocity_mps)
    assert law.motion.velocity_mps == 0.0 and fastest_mps > 0.15
    assert 0.3 < driven_m <= WALL_M - collision.front_m - collision.stop_m + 0.02


@pytest.mark.hazard("H19")
@pytest.mark.parametrize("rate_hz", [20, 50, 200])
@pytest.mark.parametrize("wanted", [Setpoint(0.5, heading_rad=0.0), Setpoint(0.5, None, 0.02), Setpoint(0.008)])
@pytest.mark.parametrize("is_seen", [True, False])
def test_a_stick_that_is_held_leads_no_farther_however_small_the_first_step(
    rate_hz: int, wanted: Setpoint, is_seen: bool
) -> None:
    """Before a wall, or floor that ends, the first step of each new start is one that would lead a bit on."""
    law = ControlLaw(ControllerSettings(arming=AUTOMATIC, collision=CollisionSettings(stale_s=10.0)), START_NS)
    left_m, tick_ns = 0.15 + 0.25 + 0.002, 10**9 // rate_hz
    ways = [left_m / math.cos(math.radians(k - 179.5)) if abs(k - 179.5) < 40 else math.inf for k in range(360)]
    ranges = tuple(way if is_seen or way == math.inf else math.nan for way in ways)
    law.take(ControllerScan(START_NS, ranges, tuple(min(way, 6.0) for way in ways)))
    for tick in range(1, 4 * rate_hz):
        now_ns = START_NS + tick * tick_ns
        law.take(ControllerPose(now_ns, 0.0, 0.0, "tracking", law.motion.velocity_mps))
        law.take(TimedSetpoint(now_ns, wanted))
        left_m -= law.step(now_ns, 1 / rate_hz).motion.velocity_mps / rate_hz
    assert law.reason == "" and left_m > 0.15 + 0.25 - 0.004


def test_where_the_images_are_those_of_a_log_neither_motion_nor_obstacles_are_compared() -> None:
    settings = ControllerSettings()
    assert not settings.of_log.motion.check and not settings.of_log.collision.check
    assert settings.motion.check and settings.collision.check and settings.without_obstacles.motion.check
    assert settings.of_log.arming == MANUAL


# The safety rules: order, deadlines, and numbers that are not finite.


def test_the_first_of_two_causes_is_reported_and_every_fault_disarms() -> None:
    reasons = list(safety_rules.RULES)
    assert len(set(reasons)) == len(reasons)
    for first, second in combinations(reasons, 2):
        assert stop_reason({second, first}) == first and stop_reason({first, ""}) == first
    order = (ENDS, ASKED, CLIFF, BUMPER, AWAITED, NO_POSE, POSE_STALE, NOT_SEEN, POSE_JUMPED, NOT_ARMED, COMMAND_STALE)
    assert sorted(order, key=reasons.index) == list(order)
    kept = {ENDS, ASKED, POSE_JUMPED, NOT_ARMED, IDLE, COMMAND_STALE}
    assert set(reasons) - set(safety_rules.FAULTS) == kept


def reason_for(pose_age_s: float = 0.1, command_age_s: float = 0.1, late_s: float = 0.0) -> str:
    """Return the reason to stop of a law that arms itself, for a pose and a command of these ages."""
    deadlines = Deadlines(pose_s=0.5, command_s=0.4, tick_s=0.25)
    law = ControlLaw(replace(ControllerSettings(deadlines, arming=AUTOMATIC).without_obstacles), 0)
    now_ns = 10**12
    law.take(ControllerPose(now_ns - round(pose_age_s * 1e9), 0.0, 0.0, "tracking"))
    law.take(TimedSetpoint(now_ns - round(command_age_s * 1e9), Setpoint(0.1)))
    return law.step(now_ns, 0.05, late_s=late_s).reason


def test_deadlines_are_in_time_and_a_stamp_of_the_future_is_not() -> None:
    """A camera with wrong stamps must not give a pose that never goes stale."""
    assert reason_for() == reason_for(0.5, 0.4, 0.25) == reason_for(-0.001, -0.001) == ""
    assert reason_for(pose_age_s=0.51) == reason_for(pose_age_s=-0.51) == POSE_STALE
    assert reason_for(command_age_s=0.41) == reason_for(command_age_s=-0.41) == COMMAND_STALE
    assert reason_for(late_s=0.26) == reason_for(late_s=math.nan) == OVERLOADED


# Sources of commands: priorities, ownership of a source by one sender, and their end.
HOLD_S = 0.5


@pytest.fixture
def selector() -> CommandSelector:
    return CommandSelector(HOLD_S)


def offer(selector: CommandSelector, at_s: float, source: str = OPERATOR, sender: str = "a") -> bool:
    """Offer a command; return whether it is the current one now."""
    command = TimedSetpoint(10**12 + round(at_s * 1e9), Setpoint(0.1), source, sender)
    selector.offer(command)
    return selector.current == command


@pytest.mark.hazard("H07")
def test_a_higher_source_takes_over_at_once_and_keeps_the_lower_one_out(selector: CommandSelector) -> None:
    assert offer(selector, 0.0, PLANNER) and offer(selector, 0.1, OPERATOR)
    assert not any(offer(selector, 0.1 + 0.1 * k, PLANNER) for k in range(6))
    assert offer(selector, 0.61, PLANNER), "the operator has been silent for longer than hold_s"
    assert selector.refused == {LOWER_PRIORITY: 6} and selector.conflict == ""


@pytest.mark.hazard("H07")
def test_the_first_sender_of_a_source_keeps_it_until_it_is_silent(selector: CommandSelector) -> None:
    assert offer(selector, 0.0, sender="a")
    for k in range(10):
        assert not offer(selector, 0.1 * k + 0.05, sender="b") and offer(selector, 0.1 * k + 0.1, sender="a")
    assert offer(selector, 1.51, sender="b"), "a has been silent since 1.0 s"
    assert not offer(selector, 1.6, sender="a")
    assert selector.refused == {OTHER_SENDER: 11}


def test_the_newest_of_reordered_commands_is_kept(selector: CommandSelector) -> None:
    assert offer(selector, 1.0) and not offer(selector, 0.9)
    assert selector.current is not None and selector.current.arrival_ns == 10**12 + 10**9


# The law of motion: heading controller, limits of speed, and goals for motor controllers that hold headings.
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
def test_the_law_reaches_the_heading_the_short_way_without_overshoot(start_rad: float, goal_rad: float) -> None:
    headings = turn(Setpoint(0.3, goal_rad), start_rad, 12.0)
    way_rad = wrap_angle(goal_rad - start_rad)
    turned = [abs(heading - start_rad) for heading in headings]
    assert abs(wrap_angle(headings[-1] - goal_rad)) < 1e-3
    assert max(turned) <= abs(way_rad) + 0.005


def test_a_turn_goes_on_although_noise_at_half_a_turn_changes_the_nearer_side() -> None:
    heading_rad, motion = 0.0, Twist()
    for i in range(12):
        measured = wrap_angle(heading_rad + (0.1 if i % 2 else -0.1))  # the nearer side changes with every step
        motion = step(Setpoint(0.0, math.pi), measured, motion)
        heading_rad += motion.yaw_rate_radps * DT_S
    assert abs(motion.yaw_rate_radps) == LIMITS.yaw_rate_radps


@pytest.mark.parametrize("value", NOT_FINITE)
@pytest.mark.parametrize("place", ["velocity", "goal", "yaw rate", "heading"])
def test_the_base_slows_to_a_stop_where_an_input_is_not_finite(value: float, place: str) -> None:
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
def test_no_step_exceeds_a_limit(seed: int) -> None:
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
