"""The control law as a whole: what its parts have to be told at each step."""

from __future__ import annotations

import cmath
import math
import random

import pytest

from omnid.core.control.arming import AUTOMATIC
from omnid.core.control.collision_monitor import CollisionSettings, ControllerScan
from omnid.core.control.command_sources import TimedSetpoint
from omnid.core.control.control_law import ControlLaw, ControllerPose, ControllerSettings
from omnid.core.control.heading_controller import Setpoint, VelocityLimits
from omnid.core.control.safety_rules import IDLE, POSE_JUMPED

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


def test_a_base_before_a_post_turns_to_a_heading_and_drives_on_from_there() -> None:
    law = ControlLaw(ControllerSettings(arming=AUTOMATIC, collision=CollisionSettings(stale_s=100.0)), START_NS)
    heading_rad = driven_m = 0.0
    for tick in range(1, 400):
        now_ns, turned = START_NS + tick * TICK_NS, round(math.degrees(heading_rad))
        # A post 0.38 m ahead of the first pose, so that the base may not begin an arc; it stays where it is.
        ranges = tuple(0.38 if abs(k - 179.5 + turned) < 8 else math.inf for k in range(360))
        law.take(ControllerScan(now_ns, ranges))
        law.take(ControllerPose(now_ns, heading_rad, law.motion.yaw_rate_radps, "tracking", 0.0))
        law.take(TimedSetpoint(now_ns, Setpoint(0.3, heading_rad=math.radians(90))))
        motion = law.step(now_ns, TICK_S).motion
        heading_rad, driven_m = heading_rad + motion.yaw_rate_radps * TICK_S, driven_m + motion.velocity_mps * TICK_S
        assert motion.velocity_mps == 0.0 or heading_rad > math.radians(10)
    assert heading_rad > math.radians(85) and driven_m > 0.5


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


def law_with(first: ControllerPose) -> ControlLaw:
    """Return a law that drives, without obstacles and without a comparison of motions, from a pose."""
    settings = ControllerSettings(arming=AUTOMATIC).of_log
    law = ControlLaw(settings, START_NS)
    law.take(first)
    law.step(first.stamp_ns, TICK_S)
    law.take(TimedSetpoint(first.stamp_ns + 1, Setpoint(0.3)))
    law.step(first.stamp_ns + 1, TICK_S)
    assert law.reason == ""
    return law


def between_rad(one_rad: float, other_rad: float) -> float:
    """Return the angle between two directions."""
    return abs(cmath.phase(cmath.exp(1j * (one_rad - other_rad))))


def test_a_heading_jumps_where_the_base_cannot_have_turned_so_far() -> None:
    """By more than 0.3 rad beyond a turn from a stand, and beyond one at the rate of the last pose, to either side.

    Each case lies shortly within or beyond one of the two terms; many headings cross pi, and some poses are older.
    """
    limits = VelocityLimits()
    rng, counts = random.Random(8), {True: 0, False: 0}
    for _ in range(1500):
        passed_s = rng.choice((-1, 1)) * rng.randrange(0, 400) * 1e-3
        before = ControllerPose(START_NS + 10**9, rng.uniform(-math.pi, math.pi), rng.uniform(-1.2, 1.2), "tracking")
        turn_rad = 0.3 + limits.yaw_rate_radps * abs(passed_s)
        brake_rad = 0.3 + limits.yaw_acceleration_radps2 * passed_s**2 / 2
        base_rad, bound_rad = rng.choice(((0.0, turn_rad), (before.yaw_rate_radps * passed_s, brake_rad)))
        heading_rad = before.heading_rad + base_rad + rng.choice((-1, 1)) * (bound_rad + rng.choice((-0.01, 0.01, 0.3)))
        pose = before._replace(
            stamp_ns=before.stamp_ns + round(passed_s * 1e9), heading_rad=math.remainder(heading_rad, math.tau)
        )
        terms = (
            between_rad(pose.heading_rad, before.heading_rad) - turn_rad,
            between_rad(pose.heading_rad, before.heading_rad + before.yaw_rate_radps * passed_s) - brake_rad,
        )
        law = law_with(before)
        law.take(pose)
        law.step(before.stamp_ns + 2, TICK_S)
        jumps = min(terms) > 0.0
        assert (law.reason == POSE_JUMPED) == jumps, (before, pose, terms)
        counts[jumps] += 1
    assert min(counts.values()) > 300


@pytest.mark.parametrize("side", [1, -1])
def test_the_goal_of_a_motor_controller_does_not_pass_a_heading_across_pi(side: int) -> None:
    """It holds headings by itself; here it is blocked, so that the goal goes as far as it may."""
    law = law_with(ControllerPose(START_NS, side * 3.13, 0.0, "tracking"))
    goals_rad = []
    for tick in range(1, 120):
        now_ns = START_NS + tick * TICK_NS
        law.take(ControllerPose(now_ns, side * 3.13, 0.0, "tracking"))
        law.take(TimedSetpoint(now_ns, Setpoint(0.0, -side * 3.13)))
        goals_rad.append(side * law.step(now_ns, TICK_S).heading_rad)
    assert max(goals_rad) == pytest.approx(math.tau - 6.26) and min(goals_rad) >= 0.0


def test_the_goal_of_a_motor_controller_moves_by_the_turn_of_each_tick() -> None:
    law, goal_rad = law_with(ControllerPose(START_NS, 0.0, 0.0, "tracking")), 0.0
    for tick, dt_s in enumerate((TICK_S, 0.05, 0.01, TICK_S, 0.03, 0.1), 1):
        now_ns = START_NS + tick * TICK_NS
        law.take(TimedSetpoint(now_ns, Setpoint(0.0, None, 0.6)))
        output = law.step(now_ns, dt_s)
        goal_rad += output.motion.yaw_rate_radps * dt_s
        assert output.heading_rad == pytest.approx(goal_rad) and output.motion.yaw_rate_radps > 0.0
    output = law.step(START_NS + 8 * TICK_NS, 9.0)
    assert output.heading_rad == pytest.approx(goal_rad + output.motion.yaw_rate_radps * 0.2), "a late tick"


def test_a_setpoint_of_the_very_instant_of_a_reason_to_stop_is_void() -> None:
    law = ControlLaw(ControllerSettings(arming=AUTOMATIC).of_log, START_NS)
    law.take(ControllerPose(START_NS, 0.0, 0.0, "tracking"))
    law.take(TimedSetpoint(START_NS, Setpoint(0.3)))
    assert law.step(START_NS, TICK_S).reason == IDLE
    law.take(TimedSetpoint(START_NS + 1, Setpoint(0.3)))
    assert law.step(START_NS + 1, TICK_S).reason == ""


def test_where_the_images_are_those_of_a_log_neither_motion_nor_obstacles_are_compared() -> None:
    settings = ControllerSettings()
    for of in (settings.of_log, settings.of_replay):
        assert not of.motion.check and not of.collision.check
    assert settings.motion.check and settings.collision.check and settings.without_obstacles.motion.check
    assert settings.of_replay.arming == AUTOMATIC
