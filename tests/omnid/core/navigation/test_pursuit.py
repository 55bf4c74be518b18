"""Pure pursuit: the arc leads to the point ahead, and a base far aside turns first."""

from __future__ import annotations

import math

import numpy as np
import pytest

from calib.se2_arrays import predicted
from omnid.core.navigation.path import drive_path, straight_leg
from omnid.core.navigation.pursuit import Approach, Pursuit
from omnid.core.navigation.settings import PursuitSettings

SETTINGS = PursuitSettings()


def at_speed(pose: tuple[float, float, float], *, backwards: bool = False) -> tuple[Approach, float]:
    """Return the motion after two seconds at a pose beside a straight path of 5 m, and its reach [m]."""
    pursuit = Pursuit(straight_leg((0.0, 0.0), (-5.0 if backwards else 5.0, 0.0), backwards=backwards), SETTINGS)
    for tick in range(20):
        approach = pursuit.step(tick * 10**8, np.array(pose), 0.3)
    low_m, high_m = SETTINGS.lookahead_m
    return approach, min(max(low_m, 0.3 * SETTINGS.lookahead_s), high_m)


@pytest.mark.parametrize("pose", [(1.0, 0.1, 0.0), (1.0, -0.15, 0.2), (2.0, 0.0, -0.3)])
@pytest.mark.parametrize("backwards", [False, True])
def test_the_arc_leads_to_the_point_ahead(pose: tuple[float, float, float], backwards: bool) -> None:
    begin = (-pose[0], *pose[1:]) if backwards else pose
    (setpoint, s_m, *_), reach_m = at_speed(begin, backwards=backwards)
    target = np.array([(s_m + reach_m) * (-1 if backwards else 1), 0.0])
    assert (setpoint.velocity_mps < 0) == backwards and setpoint.heading_rad is None
    # Driven on, the base passes through the point.
    arc_s = np.linspace(0, 2 * reach_m / abs(setpoint.velocity_mps), 2001)
    places = np.array(
        [predicted(np.array(begin), setpoint.velocity_mps, setpoint.yaw_rate_radps, t)[:2] for t in arc_s]
    )
    assert np.linalg.norm(places - target, axis=1).min() < 2e-3


def test_a_base_that_looks_away_from_the_path_turns_towards_it_standing() -> None:
    (setpoint, *_, turning), _ = at_speed((1.0, 0.0, 1.2))
    assert turning and setpoint.velocity_mps == 0 and setpoint.heading_rad == pytest.approx(0.0)
    (setpoint, *_, turning), _ = at_speed((-1.0, 0.0, -1.2), backwards=True)
    assert turning and setpoint.velocity_mps == 0 and setpoint.heading_rad == pytest.approx(0.0)


def test_backwards_it_looks_as_far_ahead_as_forwards() -> None:
    """At 0.6 m/s the point to drive to is 0.72 m ahead: twice the least distance."""
    curvatures = []
    for backwards in (False, True):
        sign = -1.0 if backwards else 1.0
        pursuit = Pursuit(straight_leg((0.0, 0.0), (sign * 5.0, 0.0), backwards=backwards), SETTINGS)
        for tick in range(20):
            setpoint = pursuit.step(tick * 10**8, np.array([sign, 0.1, 0.0]), sign * 0.6).setpoint
        curvatures.append(setpoint.yaw_rate_radps / abs(setpoint.velocity_mps))
    assert abs(curvatures[0]) == pytest.approx(2 * 0.1 / (0.72**2 + 0.1**2), rel=0.01)
    assert abs(curvatures[1]) == pytest.approx(abs(curvatures[0]))


@pytest.mark.parametrize("left_m", [0.5, 1.0, 3.0])
def test_from_its_speed_before_the_end_it_can_stop_with_less_than_the_planned_deceleration(left_m: float) -> None:
    settings = PursuitSettings(velocity_mps=3.0)
    pursuit = Pursuit(straight_leg((0.0, 0.0), (5.0, 0.0)), settings)
    for tick in range(60):
        approach = pursuit.step(tick * 10**8, np.array([5.0 - left_m, 0.0, 0.0]), 0.3)
    speed_mps = approach.setpoint.velocity_mps
    assert 0.5 * left_m < speed_mps**2 / (2 * settings.acceleration_mps2) < 0.9 * left_m


def steady(pursuit: Pursuit, pose: tuple[float, float, float], obstacle_m: float = math.inf) -> Approach:
    """Return the motion at a pose after two seconds there."""
    for tick in range(20):
        approach = pursuit.step(tick * 10**8, np.array(pose), 0.3, obstacle_m=obstacle_m)
    return approach


def test_its_speed_grows_with_the_acceleration_and_a_gap_counts_as_half_a_second() -> None:
    pursuit = Pursuit(straight_leg((0.0, 0.0), (5.0, 0.0)), PursuitSettings(velocity_mps=1.0))
    speeds = [
        pursuit.step(round(t_s * 1e9), np.zeros(3), 0.0).setpoint.velocity_mps for t_s in (1.0, 1.1, 1.3, 9.0, 8.0)
    ]
    assert speeds == pytest.approx([0.0, 0.03, 0.09, 0.24, 0.24])


@pytest.mark.parametrize(
    ("obstacle_m", "speed_mps"), [(0.7, 0.4), (0.6, 0.4), (0.3, 0.2), (0.15, 0.1), (0.0, 0.05), (-0.2, 0.05)]
)
def test_near_an_obstacle_it_drives_more_slowly_in_proportion(obstacle_m: float, speed_mps: float) -> None:
    pursuit = Pursuit(straight_leg((0.0, 0.0), (5.0, 0.0)), SETTINGS)
    assert steady(pursuit, (1.0, 0.0, 0.0), obstacle_m).setpoint.velocity_mps == pytest.approx(speed_mps)


def test_in_a_curve_it_drives_more_slowly_in_proportion_to_its_radius() -> None:
    a = np.linspace(0.0, math.pi, 40)
    for radius_m, speed_mps in ((0.5, 0.4 * 0.5 / 0.7), (1.0, 0.4), (2.0, 0.4)):
        circle = np.column_stack([radius_m * np.sin(a), radius_m - radius_m * np.cos(a)])
        (leg,) = drive_path(circle).legs
        x, y, heading = leg.at(leg.length_m / 2)
        approach = steady(Pursuit(leg, SETTINGS, leg.length_m / 2), (x, y, heading))
        assert approach.setpoint.velocity_mps == pytest.approx(speed_mps, rel=0.1)
        assert approach.setpoint.yaw_rate_radps == pytest.approx(approach.setpoint.velocity_mps / radius_m, rel=0.15)


@pytest.mark.parametrize("y_m", [0.25, -0.25])
def test_on_a_narrow_arc_back_to_a_straight_path_it_drives_more_slowly(y_m: float) -> None:
    approach = steady(Pursuit(straight_leg((0.0, 0.0), (5.0, 0.0)), SETTINGS), (1.0, y_m, 0.0))
    curvature = 2 * 0.25 / (0.36**2 + 0.25**2)
    assert approach.setpoint.velocity_mps == pytest.approx(0.4 / (0.7 * curvature), rel=0.01)


def test_before_a_narrow_curve_it_drives_more_slowly_already() -> None:
    a = np.linspace(0.0, math.pi, 40)
    (leg,) = drive_path([(0.0, 0.0), *np.column_stack([2.0 + 0.4 * np.sin(a), 0.4 - 0.4 * np.cos(a)])]).legs
    assert steady(Pursuit(leg, SETTINGS, 1.0), (1.0, 0.0, 0.0)).setpoint.velocity_mps == pytest.approx(0.4)
    assert steady(Pursuit(leg, SETTINGS, 1.75), (1.75, 0.0, 0.0)).setpoint.velocity_mps < 0.3


def test_a_limit_of_the_yaw_rate_or_of_the_path_is_kept() -> None:
    slow = PursuitSettings(yaw_rate_radps=0.1)
    approach = steady(Pursuit(straight_leg((0.0, 0.0), (5.0, 0.0)), slow), (1.0, 0.15, 0.0))
    assert approach.setpoint.yaw_rate_radps == pytest.approx(-0.1)
    (leg,) = drive_path([(0.0, 0.0), (5.0, 0.0)], speeds=[0.02, 0.02]).legs
    assert steady(Pursuit(leg, SETTINGS), (1.0, 0.0, 0.0)).setpoint.velocity_mps == pytest.approx(0.02)
    assert steady(Pursuit(leg, SETTINGS), (1.0, 0.0, 0.0), 0.1).setpoint.velocity_mps == pytest.approx(0.02)


def test_it_turns_standing_beyond_45_degrees_and_until_4_degrees_once_it_turns() -> None:
    leg = straight_leg((0.0, 0.0), (5.0, 0.0))
    for first_deg, then_deg, turns in (
        (44.0, 43.0, False),
        (-44.0, -43.0, False),
        (46.0, 43.0, True),
        (46.0, 4.5, True),
        (-46.0, -4.5, True),
        (46.0, 3.5, False),
    ):
        pursuit = Pursuit(leg, SETTINGS)
        steady(pursuit, (1.0, 0.0, 0.0))
        pursuit.step(2 * 10**9, np.array([1.0, 0.0, math.radians(first_deg)]), 0.0)
        approach = pursuit.step(21 * 10**8, np.array([1.0, 0.0, math.radians(then_deg)]), 0.0)
        assert approach.turning == turns, (first_deg, then_deg)
    pursuit = Pursuit(leg, SETTINGS)
    assert not any(pursuit.step(tick * 10**8, np.array([1.0, 0.0, 0.2]), 0.0).turning for tick in range(3))
    pursuit.step(3 * 10**8, np.array([1.0, 0.0, 1.0]), 0.0)
    assert pursuit.step(4 * 10**8, np.array([1.0, 0.0, 0.0]), 0.0).setpoint.velocity_mps == pytest.approx(0.03)


def test_the_last_centimetres_are_slow_and_past_the_end_it_stands() -> None:
    for left_m, speed_mps in ((0.1, 0.12), (0.05, 0.06), (0.01, 0.02), (-0.01, 0.0)):
        pursuit = Pursuit(straight_leg((0.0, 0.0), (5.0, 0.0)), SETTINGS, 4.9)
        approach = steady(pursuit, (5.0 - left_m, 0.0, 0.0))
        assert approach.left_m == pytest.approx(left_m)
        assert approach.setpoint.velocity_mps == pytest.approx(speed_mps)
    pursuit = Pursuit(straight_leg((0.0, 0.0), (5.0, 0.0)), SETTINGS, 4.9)
    for tick in range(20):
        approach = pursuit.step(tick * 10**8, np.array([4.95, 0.0, 0.0]), 0.3, stops_at_end=False)
    assert approach.setpoint.velocity_mps == pytest.approx(0.4)


def test_the_point_to_drive_to_is_no_nearer_and_no_farther_than_its_limits() -> None:
    for speed_mps, reach_m in ((0.0, 0.35), (0.1, 0.35), (0.5, 0.6), (3.0, 0.9)):
        pursuit = Pursuit(straight_leg((0.0, 0.0), (5.0, 0.0)), SETTINGS)
        for tick in range(20):
            setpoint = pursuit.step(tick * 10**8, np.array([1.0, 0.1, 0.0]), speed_mps).setpoint
        curvature = setpoint.yaw_rate_radps / setpoint.velocity_mps
        assert curvature == pytest.approx(-2 * 0.1 / (reach_m**2 + 0.1**2), rel=1e-3)
