"""Goals and paths in a closed loop with the control law: a base with inertia, unequal wheels and delayed poses."""

from __future__ import annotations

import math

import numpy as np
import pytest

from omnid.core.navigation.navigator import Navigator
from omnid.core.navigation.path import DrivePath, drive_path, straight_leg
from omnid.core.navigation.requests import NavigationFrame
from omnid.core.navigation.settings import NavigationSettings
from omnid.navigation_state import NavigationState
from tests.omnid.core.navigation.driven_base import DrivenBase

GOAL_M, GOAL_RAD = 0.03, math.radians(1)


def to_goal(base: DrivenBase, x: float, y: float, heading: float | None) -> None:
    """Begin to drive to a goal in odom."""
    path = DrivePath((straight_leg(base.pose, (x, y)),), heading)
    base.navigator.start("goal", NavigationFrame.ODOM, [path], base.seen())


@pytest.mark.parametrize(
    ("goal", "first"),
    [
        ((10.0, 0.0, 0.0), 0),
        ((3.0, 2.0, math.pi / 2), 4),
        ((-2.0, -1.0, 0.3), 8),
        ((0.0, 0.0, math.pi), 12),
        ((0.06, 0.03, 0.0), 14),
    ],
)
@pytest.mark.parametrize("seeds", [range(2), pytest.param(range(2, 4), marks=pytest.mark.slow)])
def test_reaches_goals_within_3_cm_and_1_degree(goal: tuple[float, float, float], first: int, seeds: range) -> None:
    for seed in (first + more for more in seeds):
        base = DrivenBase(Navigator(NavigationSettings()), seed)
        to_goal(base, *goal)
        assert base.run(90).state is NavigationState.REACHED
        away_m, turned_rad = base.error(goal)
        assert away_m < GOAL_M and turned_rad < GOAL_RAD, seed
        assert abs(base.v) < 0.01 and abs(base.w) < 0.01, "every end is a stop"


def test_drives_a_square_of_10_m_and_turns_at_its_corners() -> None:
    corners = [(0.0, 0.0), (2.5, 0.0), (2.5, 2.5), (0.0, 2.5), (0.0, 0.0)]
    path = drive_path(corners, 0.0)
    assert len(path.legs) == 4
    for seed in range(3):
        base = DrivenBase(Navigator(NavigationSettings()), seed)
        base.navigator.start("path", NavigationFrame.ODOM, [path], base.seen())
        assert base.run(120).state is NavigationState.REACHED
        away_m, turned_rad = base.error((0.0, 0.0, 0.0))
        assert away_m < GOAL_M and turned_rad < GOAL_RAD
        xy = np.array([sample.pose[:2] for sample in base.samples])
        for corner in corners:
            assert np.hypot(*(xy - corner).T).min() < 0.06
        beside = np.minimum.reduce([np.abs(xy[:, 0]), np.abs(xy[:, 0] - 2.5), np.abs(xy[:, 1]), np.abs(xy[:, 1] - 2.5)])
        assert np.percentile(beside, 95) < 0.05


def test_follows_curves_within_5_cm_and_slows_down_in_them() -> None:
    s = np.linspace(0, 4 * math.pi, 200)
    points = np.column_stack([s, np.sin(1.5 * s)])
    base = DrivenBase(Navigator(NavigationSettings()), 1)
    base.navigator.start("path", NavigationFrame.ODOM, [drive_path(points)], base.seen())
    assert base.run(120).state is NavigationState.REACHED
    t = np.linspace(0, 4 * math.pi, 4000)
    fine = np.column_stack([t, np.sin(1.5 * t)])
    away = [np.hypot(*(fine - sample.pose[:2]).T).min() for sample in base.samples]
    assert np.percentile(away, 95) < 0.05
    speeds = [sample.speed_mps for sample in base.samples if 1 < sample.pose[0] < 11]
    assert max(speeds) > 0.3 and min(speeds) < 0.8 * max(speeds)


def test_drives_backwards_where_the_path_was_driven_so() -> None:
    points = [(0.0, 0.0), (2.0, 0.0), (1.0, 0.0)]
    path = drive_path(points, 0.0, backwards=[False, False, True])
    assert [leg.backwards for leg in path.legs] == [False, True]
    base = DrivenBase(Navigator(NavigationSettings()), 2)
    base.navigator.start("path", NavigationFrame.ODOM, [path], base.seen())
    assert base.run(60).state is NavigationState.REACHED
    assert min(sample.speed_mps for sample in base.samples) < -0.2
    assert max(abs(float(sample.pose[2])) for sample in base.samples) < 0.3, "it does not turn round"


def test_follows_the_map_when_it_is_corrected() -> None:
    base = DrivenBase(Navigator(NavigationSettings()), 6, T_map_odom=(1.0, -0.5, 0.4))
    pose = base.seen().map_pose()
    goal = pose + np.array([3.0, 1.0, 0.2])
    base.navigator.start("goal", NavigationFrame.MAP, [DrivePath((straight_leg(pose, goal),), goal[2])], base.seen())
    base.run(60, lambda answer: answer.left_m < 1.5, rest_s=0)
    base.T_map_odom = base.T_map_odom + np.array([0.1, 0.05, 0.02])
    assert base.run(60).state is NavigationState.REACHED
    found = base.seen().map_pose()
    assert math.dist(found[:2], goal[:2]) < 0.04 and abs(found[2] - goal[2]) < 0.03
