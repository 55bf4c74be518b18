"""Trust in pose and motor: levels, times, switches, and how slowly a base drives."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest

from omnid.core.control.heading_controller import Twist, VelocityLimits
from omnid.core.control.motion_monitor import Motion, MotionSettings
from omnid.core.control.safety_rules import SafetyInputs
from omnid.core.control.trust import POSE_DEGRADED, MotorReport, Plausibility, TrustSettings

NS = 10**9
LIMITS = VelocityLimits(velocity_mps=0.8, yaw_rate_radps=1.5)
STILL = Motion(0.0, 0.0)
SURE, UNSURE, TURNING = (0.01, 0.01), (0.5, 0.01), (0.01, 0.9)


def judged(plausibility: Plausibility) -> SafetyInputs:
    return plausibility.added_to(SafetyInputs(0.0, "tracking", 0.0))


def is_unsure(*sigmas: tuple[float, float], settings: TrustSettings | None = None) -> bool:
    """Return whether the pose is unsure after poses 0.1 s apart, with sigmas of velocity and yaw rate."""
    plausibility = Plausibility(settings or TrustSettings(), MotionSettings())
    for number, pair in enumerate(sigmas):
        plausibility.add_pose(number * NS // 10, "tracking", Motion(0.0, 0.0, *pair), 0)
    return judged(plausibility).pose_unsure


@pytest.mark.parametrize("sigmas", [UNSURE, TURNING, (math.nan, 0.0), (math.inf, math.inf)])
def test_a_pose_is_unsure_for_a_time_before_it_counts(sigmas: tuple[float, float]) -> None:
    assert not is_unsure(SURE, *[sigmas] * 3), "0.2 s: a refused frame and the one after it"
    assert is_unsure(SURE, *[sigmas] * 4)
    assert not is_unsure(SURE, *[sigmas] * 9, SURE)
    assert not is_unsure(*[sigmas, sigmas, SURE] * 5)
    off = TrustSettings(velocity_sigma_mps=0.0, yaw_rate_sigma_radps=0.0)
    assert not is_unsure(*[sigmas] * 9, settings=off)


@pytest.mark.parametrize("mode", ["stop", "ignore"])
def test_a_reset_counts_once(mode: str) -> None:
    plausibility = Plausibility(replace(TrustSettings(), odometry_reset=mode), MotionSettings())
    for number, (resets, expected) in enumerate([(3, False), (3, False), (4, mode == "stop"), (4, False)]):
        plausibility.add_pose(number, "tracking", STILL, resets)
        assert judged(plausibility).pose_reset is expected and not judged(plausibility).pose_reset


def test_a_battery_is_empty_once_its_voltage_stays_low() -> None:
    def reports(*volts: float, level_v: float = 11.0) -> list[bool]:
        """Return after each report, 0.5 s apart, whether the battery is empty."""
        plausibility, found = Plausibility(TrustSettings(battery_v=level_v), MotionSettings()), []
        for number, battery_v in enumerate(volts):
            plausibility.add_report(number * NS // 2, MotorReport(STILL, 0, battery_v))
            found.append(judged(plausibility).battery_empty)
        return found

    assert reports(12.0, *[10.9] * 5) == [False] * 5 + [True], "2 s"
    assert not any(reports(*[10.9, 10.9, 12.0] * 5)), "a motor that starts"
    assert not any(reports(*[math.nan] * 20)) and not any(reports(*[1.0] * 20, level_v=0.0))


@pytest.mark.parametrize("fault", [1, -1, 1 << 31])
def test_a_fault_counts_while_it_is_reported(fault: int) -> None:
    plausibility = Plausibility(TrustSettings(), MotionSettings())
    for reported in (fault, 0, fault):
        plausibility.add_report(0, MotorReport(STILL, reported))
        assert judged(plausibility).motor_faulty is bool(reported)


@pytest.mark.parametrize("side", [1, -1])
def test_a_degraded_pose_slows_down_to_its_share_of_the_limits(side: int) -> None:
    plausibility = Plausibility(TrustSettings(degraded_speed=0.4), MotionSettings())
    fast, slow = Twist(side * 0.7, -side * 1.4), Twist(side * 0.3, -side * 0.5)
    for state, expected in (("tracking", fast), ("degraded", Twist(side * 0.32, -side * 0.6)), ("tracking", fast)):
        plausibility.add_pose(1, state, STILL, 0)
        assert plausibility.slowed_by == (POSE_DEGRADED if state == "degraded" else "")
        slowed = plausibility.slowed(fast, LIMITS)
        assert slowed.velocity_mps == pytest.approx(expected.velocity_mps)
        assert slowed.yaw_rate_radps == pytest.approx(expected.yaw_rate_radps)
        assert plausibility.slowed(slow, LIMITS) == slow, "within the share already"
