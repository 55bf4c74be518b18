"""Commanded, reported and seen motion: every contradiction slows down and stops, nothing that robots do is one."""

from __future__ import annotations

import math
import random
from collections.abc import Callable
from dataclasses import dataclass

import pytest

from omnid.core.control.heading_controller import Twist, VelocityLimits
from omnid.core.control.motion_monitor import (
    BATTERY_EMPTY,
    NOT_COMMANDED,
    NOT_FOLLOWED,
    NOT_SEEN,
    POSE_UNSURE,
    REST_S,
    Motion,
    MotionSettings,
    Plausibility,
    TrustSettings,
)

TICK_S, POSE_S, DELAY_S = 0.05, 0.1, 0.15  # of the ticks, of the poses, from an image to the arrival of its pose
NS = 10**9
LIMITS = VelocityLimits()
Wish = Callable[[float], Twist]
View = Callable[[float, Motion], Motion]


@dataclass(frozen=True, slots=True)
class World:
    """A base with a lag that follows its commands, and what becomes of its motion in images and reports."""

    lag_s: float = 0.15  # time constant of the wheels
    grip: float = 1.0  # share of the wheels' motion that the ground sees
    seen: View = lambda _, motion: motion
    reported: View = lambda _, motion: motion
    noise_mps: float = 0.02
    steps_s: float = POSE_S


def run(
    wish: Wish, seconds: float, world: World | None = None, settings: MotionSettings | None = None
) -> tuple[Plausibility, list[tuple[float, bool, str]]]:
    """Return the monitor, and time, doubt and reason of each tick."""
    world, rng = world or World(), random.Random(7)
    monitor, commanded, wheels = Plausibility(TrustSettings(), settings or MotionSettings()), Twist(), Twist()
    waiting: list[tuple[float, Motion]] = []
    history = []
    for tick in range(round(seconds / TICK_S)):
        now_s = tick * TICK_S
        commanded = LIMITS.step(wish(now_s), commanded, TICK_S)
        monitor.add_command(round(now_s * NS), commanded)
        share = 1 - math.exp(-TICK_S / world.lag_s)
        wheels = Twist(
            wheels.velocity_mps + share * (commanded.velocity_mps - wheels.velocity_mps),
            wheels.yaw_rate_radps + share * (commanded.yaw_rate_radps - wheels.yaw_rate_radps),
        )
        monitor.add_report(round(now_s * NS), world.reported(now_s, Motion(*_pair(wheels))), 0, math.nan)
        if now_s >= len(waiting) * world.steps_s:
            moved = Motion(world.grip * wheels.velocity_mps, world.grip * wheels.yaw_rate_radps, 0.01, 0.01)
            noisy = moved._replace(velocity_mps=moved.velocity_mps + rng.gauss(0, world.noise_mps))
            waiting.append((now_s, world.seen(now_s, noisy)))
        for stamp_s, motion in [entry for entry in waiting if now_s - TICK_S < entry[0] + DELAY_S <= now_s]:
            monitor.add_pose(round(stamp_s * NS), "tracking", motion, 0)
        history.append((now_s, monitor.is_doubtful, monitor.reason))
    return monitor, history


def _pair(motion: Twist) -> tuple[float, float]:
    return motion.velocity_mps, motion.yaw_rate_radps


def steady(velocity_mps: float, yaw_rate_radps: float = 0.0) -> Wish:
    return lambda _: Twist(velocity_mps, yaw_rate_radps)


def stopped_after(history: list[tuple[float, bool, str]]) -> tuple[float, float, str]:
    """Return when it slowed down, when it stopped, and why."""
    slowed = next(at_s for at_s, doubtful, _ in history if doubtful)
    at_s, _, reason = next(entry for entry in history if entry[2])
    return slowed, at_s, reason


def still(_: float, motion: Motion) -> Motion:
    return motion._replace(velocity_mps=0.002 * math.copysign(1.0, motion.velocity_mps), yaw_rate_radps=0.0)


def bumps(at_s: float, motion: Motion) -> Motion:
    """Return a motion with a jolt of two images every 1.5 s."""
    jolt = 0.4 if at_s % 1.5 < 0.15 else 0.0
    return motion._replace(velocity_mps=motion.velocity_mps - jolt, yaw_rate_radps=motion.yaw_rate_radps + jolt)


def alternating(at_s: float) -> Twist:
    return Twist(0.6 if at_s % 4 < 2 else -0.6, 1.0 if at_s % 3 < 1.5 else -1.0)


def no_images(at_s: float, motion: Motion) -> Motion:
    """Return what a refused pose says: nothing is known of the velocity."""
    return Motion(0.0, 0.0, 1.0, 1.0) if 2 < at_s < 6 else motion


HONEST: dict[str, tuple[Wish, World]] = {
    "rest": (steady(0.0), World()),
    "fast": (steady(0.6, 1.2), World()),
    "slow wheels": (steady(-0.5), World(lag_s=0.3)),
    "creeping": (steady(0.05, 0.1), World()),
    "to and fro": (alternating, World()),
    "to and fro, 4 Hz": (alternating, World(lag_s=0.3, steps_s=0.25)),
    "slip": (steady(0.5, 0.8), World(grip=0.65)),
    "wheels too large": (steady(0.5, 0.8), World(grip=1.3)),
    "bumps": (steady(0.5), World(seen=bumps)),
    "no pose": (steady(0.5), World(seen=no_images)),
    "wheels that report nothing": (steady(0.5), World(reported=lambda *_: Motion(0.0, 0.0))),
    "wheels that hold a heading": (
        steady(0.5, 0.5),
        World(reported=lambda _, motion: motion._replace(yaw_rate_radps=math.nan)),
    ),
    "noise": (steady(0.3), World(noise_mps=0.06)),
}


@pytest.mark.parametrize(("wish", "world"), HONEST.values(), ids=HONEST)
def test_motions_of_usual_robots_are_no_contradiction(wish: Wish, world: World) -> None:
    _, history = run(wish, 60.0, world)
    assert [entry for entry in history if entry[1] or entry[2]] == []


CONTRADICTIONS: dict[str, tuple[Wish, World, str]] = {
    "images stand": (steady(0.3), World(seen=still), NOT_SEEN),
    "in reverse": (steady(-0.3), World(seen=still), NOT_SEEN),
    "turning": (steady(0.0, 0.8), World(seen=still), NOT_SEEN),
    "too far": (steady(0.3), World(seen=lambda _, m: m._replace(velocity_mps=4 * m.velocity_mps)), NOT_COMMANDED),
    "rotation": (steady(0.3), World(seen=lambda _, m: m._replace(yaw_rate_radps=0.5)), NOT_COMMANDED),
    "the other way": (steady(0.3), World(seen=lambda _, m: m._replace(velocity_mps=-m.velocity_mps)), NOT_SEEN),
    "images stand later": (steady(0.3), World(seen=lambda at_s, m: still(at_s, m) if at_s > 5 else m), NOT_SEEN),
    "wheels stand": (steady(0.3), World(reported=lambda at_s, m: Motion(0.0, 0.0) if at_s > 2 else m), NOT_FOLLOWED),
    "wheels run away": (steady(0.2), World(reported=lambda at_s, m: Motion(2.0, 0.0)), NOT_FOLLOWED),
    "wheels turn": (steady(0.2), World(reported=lambda _, m: Motion(m.velocity_mps, 1.0)), NOT_FOLLOWED),
}


@pytest.mark.hazard("H38")
@pytest.mark.parametrize(("wish", "world", "expected"), CONTRADICTIONS.values(), ids=CONTRADICTIONS)
def test_a_contradiction_slows_down_and_then_stops(wish: Wish, world: World, expected: str) -> None:
    slowed_s, stopped_s, reason = stopped_after(run(wish, 12.0, world)[1])
    assert reason == expected and slowed_s < stopped_s


def test_pushing_by_hand_is_no_contradiction() -> None:
    """Nothing drives the wheels, and the images show a motion."""
    _, history = run(steady(0.0), 20.0, World(seen=lambda *_: Motion(0.6, 0.5), reported=lambda *_: Motion(0.6, 0.5)))
    assert [entry for entry in history if entry[1] or entry[2]] == []


def test_rest_forgets_what_was_unexplained() -> None:
    def wish(at_s: float) -> Twist:
        return Twist(0.3) if at_s < 6.0 else Twist()

    monitor, history = run(wish, 6.0 + REST_S + 1.0, World(seen=still))
    held_s = max(at_s for at_s, _, reason in history if reason)
    assert held_s > 6.0 + 0.8 * REST_S and not monitor.reason and not monitor.is_doubtful


# Trust in pose and motor: levels, times, switches.
STILL = Motion(0.0, 0.0)
SURE, UNSURE, TURNING = (0.01, 0.01), (0.5, 0.01), (0.01, 0.9)


def is_unsure(*sigmas: tuple[float, float], settings: TrustSettings | None = None) -> bool:
    """Return whether the pose is unsure after poses 0.1 s apart, with sigmas of velocity and yaw rate."""
    plausibility = Plausibility(settings or TrustSettings(), MotionSettings())
    for number, pair in enumerate(sigmas):
        plausibility.add_pose(number * NS // 10, "tracking", Motion(0.0, 0.0, *pair), 0)
    return POSE_UNSURE in plausibility.take()


@pytest.mark.parametrize("sigmas", [UNSURE, TURNING, (math.nan, 0.0), (math.inf, math.inf)])
def test_a_pose_is_unsure_for_a_time_before_it_counts(sigmas: tuple[float, float]) -> None:
    assert not is_unsure(SURE, *[sigmas] * 3), "0.2 s: a refused frame and the one after it"
    assert is_unsure(SURE, *[sigmas] * 4)
    assert not is_unsure(SURE, *[sigmas] * 9, SURE)
    assert not is_unsure(*[sigmas, sigmas, SURE] * 5)
    off = TrustSettings(velocity_sigma_mps=0.0, yaw_rate_sigma_radps=0.0)
    assert not is_unsure(*[sigmas] * 9, settings=off)


def test_a_battery_is_empty_once_its_voltage_stays_low() -> None:
    def reports(*volts: float, level_v: float = 11.0) -> list[bool]:
        """Return after each report, 0.5 s apart, whether the battery is empty."""
        plausibility, found = Plausibility(TrustSettings(battery_v=level_v), MotionSettings()), []
        for number, battery_v in enumerate(volts):
            plausibility.add_report(number * NS // 2, STILL, 0, battery_v)
            found.append(BATTERY_EMPTY in plausibility.take())
        return found

    assert reports(12.0, *[10.9] * 5) == [False] * 5 + [True], "2 s"
    assert not any(reports(*[10.9, 10.9, 12.0] * 5)), "a motor that starts"
    assert not any(reports(*[math.nan] * 20)) and not any(reports(*[1.0] * 20, level_v=0.0))
