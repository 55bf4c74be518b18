"""Trust in pose and motor: levels, times, and switches."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest

from omnid.core.control.trust import MotorTrust, PoseTrust, TrustSettings

NS = 10**9
SURE, UNSURE, TURNING = (0.01, 0.01), (0.5, 0.01), (0.01, 0.9)


def poses(*sigmas: tuple[float, float], settings: TrustSettings | None = None) -> PoseTrust:
    """Return the trust after poses 0.1 s apart."""
    trust = PoseTrust(settings or TrustSettings())
    for number, pair in enumerate(sigmas):
        trust.add_pose(number * NS // 10, *pair, 0)
    return trust


@pytest.mark.parametrize("sigmas", [UNSURE, TURNING, (math.nan, 0.0), (math.inf, math.inf)])
def test_a_pose_is_unsure_for_a_time_before_it_counts(sigmas: tuple[float, float]) -> None:
    assert not poses(SURE, *[sigmas] * 3).unsure, "0.2 s: a refused frame and the one after it"
    assert poses(SURE, *[sigmas] * 4).unsure
    assert not poses(SURE, *[sigmas] * 9, SURE).unsure
    assert not poses(*[sigmas, sigmas, SURE] * 5).unsure


def test_levels_may_be_switched_off() -> None:
    off = replace(TrustSettings(), velocity_sigma_mps=0.0, yaw_rate_sigma_radps=0.0, odometry_reset="ignore")
    assert not poses(*[(9.0, 9.0)] * 9, settings=off).unsure
    trust = PoseTrust(off)
    for resets in (0, 1):
        trust.add_pose(resets, *SURE, resets)
    assert not trust.take_reset()


def test_a_reset_counts_once() -> None:
    trust = PoseTrust(TrustSettings())
    for number, (resets, expected) in enumerate([(3, False), (3, False), (4, True), (4, False)]):
        trust.add_pose(number, *SURE, resets)
        assert trust.take_reset() is expected and not trust.take_reset()


def reports(*volts: float, level_v: float = 11.0) -> list[bool]:
    """Return after each report, 0.5 s apart, whether the battery is empty."""
    trust, found = MotorTrust(replace(TrustSettings(), battery_v=level_v)), []
    for number, battery_v in enumerate(volts):
        trust.add_report(number * NS // 2, 0, battery_v)
        found.append(trust.battery_empty)
    return found


def test_a_battery_is_empty_once_its_voltage_stays_low() -> None:
    assert reports(12.0, *[10.9] * 5) == [False] * 5 + [True], "2 s"
    assert not any(reports(*[10.9, 10.9, 12.0] * 5)), "a motor that starts"
    assert not any(reports(*[math.nan] * 20)) and not any(reports(*[1.0] * 20, level_v=0.0))


@pytest.mark.parametrize("fault", [1, 4, -1, 1 << 31])
def test_a_fault_counts_while_it_is_reported(fault: int) -> None:
    for mode, expected in (("stop", True), ("ignore", False)):
        trust = MotorTrust(replace(TrustSettings(), motor_fault=mode))
        trust.add_report(0, fault, 12.0)
        assert trust.faulty is expected
        trust.add_report(1, 0, 12.0)
        assert not trust.faulty
