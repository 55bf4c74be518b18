"""Pure pursuit: the arc leads to the point ahead, and a base far aside turns first."""

from __future__ import annotations

import math

import numpy as np
import pytest

from calib.se2_arrays import predicted
from omnid.core.navigation.path import straight_leg
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
    assert turning and setpoint.velocity_mps == 0 and math.cos(setpoint.heading_rad or 0.0) == pytest.approx(1.0)


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
