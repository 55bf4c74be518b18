"""Following of a path of several legs: a corner is cut where a detour has come to the next leg, and nowhere else."""

from __future__ import annotations

import dataclasses
import math

import numpy as np
import pytest

from omnid.core.navigation.follower import CORRECTIONS, SETTLED, SKIP_M, STAND, Follower, Following
from omnid.core.navigation.path import DrivePath, drive_path, straight_leg
from omnid.core.navigation.settings import NavigationSettings

CORNER = [(0.0, 0.0), (3.0, 0.0), (3.0, 3.0)]


@pytest.mark.parametrize(
    ("place", "is_cut"),
    [((2.95, 0.6), True), ((2.5, 0.05), False), ((2.0, 0.4), False), ((3.0 - SKIP_M - 0.3, 0.6), False)],
)
def test_a_detour_that_comes_to_the_next_leg_cuts_the_corner(place: tuple[float, float], is_cut: bool) -> None:
    follower = Follower(drive_path(CORNER), NavigationSettings())
    pose = np.array([*place, 0.0])
    follower.step(0, pose * (1, 0, 1), 0.0, 0.0)
    follower.skip_corner(pose)
    ahead = follower.path_ahead(1.0)
    assert (ahead[0, 0] > 2.9) == is_cut
    if is_cut:
        assert follower.leg_left_m == pytest.approx(3.0 - place[1], abs=0.06)


@pytest.mark.parametrize("side", [1.0, -1.0])
def test_a_detour_to_either_side_cuts_the_corner_of_its_own_leg(side: float) -> None:
    points = np.array([*CORNER, (6.0, 3.0), (6.0, 9.0)]) * (1.0, side)
    follower = Follower(drive_path(points), NavigationSettings(), leg=1)
    follower.step(0, np.array([3.0, side * 2.0, side * np.pi / 2]), 0.0, 0.0)
    follower.skip_corner(np.array([3.5, side * 2.95, 0.0]))
    assert follower.leg_left_m == pytest.approx(2.5, abs=0.06)
    np.testing.assert_allclose(follower.path_ahead(0.5)[-1], (4.0, side * 3.0), atol=0.06)
    assert follower.step(10**8, np.array([3.5, side * 2.95, 0.0]), 0.0, 0.0).left_m == pytest.approx(
        2.5 + 6.0, abs=0.06
    )


@pytest.mark.parametrize("left_m", [3.0, 0.5])
def test_the_last_leg_is_not_left(left_m: float) -> None:
    follower = Follower(drive_path(CORNER), NavigationSettings(), leg=1, s_m=3.0 - left_m)
    follower.skip_corner(np.array([2.0, 2.0, 0.0]))
    assert follower.leg_left_m == pytest.approx(left_m)


def test_the_path_ahead_of_a_middle_leg_is_that_of_the_legs_behind_it() -> None:
    follower = Follower(drive_path([*CORNER, (6.0, 3.0), (6.0, 9.0)]), NavigationSettings(), leg=1, s_m=2.5)
    ahead = follower.path_ahead(2.0)
    np.testing.assert_allclose(ahead[0], (3.0, 2.5), atol=1e-6)
    assert np.hypot(*np.diff(ahead, axis=0).T).max() < 0.06
    np.testing.assert_allclose(ahead[-1], (5.0, 3.0), atol=0.06)


def test_the_path_ahead_goes_on_behind_the_next_corner() -> None:
    follower = Follower(drive_path(CORNER), NavigationSettings(), s_m=2.5)
    follower.step(0, np.array([2.5, 0.0, 0.0]), 0.0, 0.0)
    ahead = follower.path_ahead(1.5)
    np.testing.assert_allclose(ahead[0], (2.5, 0.0), atol=1e-6)
    assert np.hypot(*(ahead - (3.0, 1.0)).T).min() < 0.03, "1.5 m from there"
    assert np.hypot(*np.diff(ahead, axis=0).T).max() < 0.06, "without a gap"


def standing(follower: Follower, pose: tuple[float, float, float], yaw_rate_radps: float = 0.0) -> list[Following]:
    """Return the answers while the base stands at a pose for as long as it needs to count as settled."""
    return [follower.step(k * 10**8, np.array(pose), 0.0, yaw_rate_radps) for k in range(SETTLED)]


@pytest.mark.parametrize(("heading", "backwards"), [(0.0, True), (3.0, False), (1.2, True), (1.9, False)])
def test_a_base_that_is_just_past_its_goal_backs_up_to_it_unless_it_looks_at_it(
    heading: float, backwards: bool
) -> None:
    follower = Follower(drive_path([(0.0, 0.0), (1.0, 0.0)]), NavigationSettings())
    follower.step(0, np.array([1.0, 0.0, 0.0]), 0.0, 0.0)
    follower.step(0, np.array([1.04, 0.0, 0.0]), 0.3, 0.0)
    for k in range(SETTLED):
        assert follower.pursuit is None
        follower.step(k * 10**8, np.array([1.04, 0.0, heading]), 0.0, 0.0)
    assert follower.pursuit is not None and follower.pursuit.leg.backwards == backwards
    assert follower.pursuit.leg.length_m == pytest.approx(0.04)


def test_a_base_that_still_turns_has_not_arrived() -> None:
    follower = Follower(drive_path([(0.0, 0.0), (1.0, 0.0)]), NavigationSettings())
    follower.step(0, np.array([1.0, 0.0, 0.0]), 0.0, 0.0)
    assert not any(answer.done for answer in standing(follower, (1.0, 0.0, 0.0), 0.3))
    assert not any(answer.done for answer in standing(follower, (1.0, 0.0, 0.0), -0.3))
    assert standing(follower, (1.0, 0.0, 0.0))[-1].done


def stepped(follower: Follower, x_m: float, y_m: float, yaw: float = 0.0, speed_mps: float = 0.0) -> Following:
    """Return the answer at a pose of a base that is followed for the first time."""
    return follower.step(0, np.array([x_m, y_m, yaw]), speed_mps, 0.0)


def test_the_way_left_counts_all_legs_and_a_corner_is_where_3_cm_of_one_are_left() -> None:
    follower = Follower(drive_path([*CORNER, (5.0, 3.0)]), NavigationSettings())
    following = stepped(follower, 1.0, 0.1)
    assert following.left_m == pytest.approx(2.0 + 3.0 + 2.0) and following.offset_m == pytest.approx(0.1)
    assert not following.turning and not following.done
    following = stepped(follower, 2.95, 0.0)
    assert following.left_m == pytest.approx(0.05 + 3.0 + 2.0) and follower.leg_left_m == pytest.approx(0.05)
    following = stepped(follower, 2.975, 0.0)
    assert following.setpoint == STAND and following.turning and following.left_m == pytest.approx(5.0)
    assert follower.leg_left_m == pytest.approx(3.0)
    following = stepped(follower, 3.0, 0.0)
    assert following.turning and following.setpoint.heading_rad == pytest.approx(np.pi / 2), "towards the next leg"


def test_the_last_leg_ends_a_quarter_of_the_tolerance_before_the_goal() -> None:
    follower = Follower(drive_path(CORNER, 0.5), NavigationSettings(goal_cm=4.0), leg=1, s_m=2.9)
    assert stepped(follower, 3.0, 2.985, np.pi / 2).setpoint.heading_rad is None
    assert follower.pursuit is not None
    following = stepped(follower, 3.0, 2.995, np.pi / 2)
    assert follower.pursuit is None and following.turning and not following.done
    assert following.setpoint.velocity_mps == 0.0 and following.setpoint.heading_rad == pytest.approx(0.5)
    assert following.left_m == pytest.approx(0.005)
    assert follower.leg_left_m == 0.0
    np.testing.assert_allclose(follower.path_ahead(1.0), [(3.0, 3.0)])


def test_the_way_is_judged_where_the_base_is_when_the_command_takes_effect() -> None:
    follower = Follower(drive_path(CORNER), NavigationSettings())
    assert stepped(follower, 1.0, 0.0, speed_mps=0.4).left_m == pytest.approx(5.0 - 0.04)


def test_at_the_goal_it_needs_no_drive_and_has_arrived_where_it_stands_in_the_direction_that_is_asked() -> None:
    path = DrivePath((straight_leg((1.0, 0.0), (1.0, 0.01)),), 0.2)
    for yaw, arrives in ((0.2, True), (0.2 - 0.008, True), (0.2 + 0.02, False), (0.2 - 0.02, False)):
        answers = standing(Follower(path, NavigationSettings()), (1.0, 0.01, yaw))
        assert answers[-1].done == arrives and not any(answer.done for answer in answers[:-1])
        assert all(answer.setpoint.velocity_mps == 0.0 for answer in answers)
    answers = standing(Follower(path, NavigationSettings()), (1.0, 0.01, 0.2))
    assert answers[-1].missed_m == pytest.approx(0.0) and answers[-1].left_m == 0.0
    assert not answers[-1].turning and answers[0].turning
    assert all(answer.offset_m == 0.0 for answer in answers)
    assert standing(Follower(DrivePath(path.legs, 3.14), NavigationSettings()), (1.0, 0.01, -3.14))[-1].done


@pytest.mark.parametrize(("length_m", "is_driven"), [(0.019, False), (0.03, True), (1.5, True)])
def test_a_way_longer_than_the_tolerance_is_driven(length_m: float, is_driven: bool) -> None:
    follower = Follower(DrivePath((straight_leg((0.0, 0.0), (length_m, 0.0)),)), NavigationSettings(goal_cm=2.0))
    assert (follower.pursuit is not None) == is_driven


def test_to_stand_is_no_speed_no_heading_and_no_turn() -> None:
    assert dataclasses.astuple(STAND) == (0.0, None, 0.0)


@pytest.mark.parametrize(
    ("pose", "backwards"),
    [((1.04, 0.0, -1.2), True), ((1.04, 0.0, -3.0), False), ((1.001, 0.04, 1.0), True), ((1.001, 0.04, -1.0), False)],
)
def test_what_is_missing_to_the_goal_is_driven_with_the_end_that_is_nearer_to_it(
    pose: tuple[float, float, float], backwards: bool
) -> None:
    follower = Follower(drive_path([(0.0, 0.0), (1.0, 0.0)]), NavigationSettings(), s_m=0.9)
    follower.step(0, np.array([1.04, 0.0, 0.0]), 0.0, 0.0)
    answers = standing(follower, pose)
    assert follower.pursuit is not None and follower.pursuit.leg.backwards == backwards
    begins = answers[-2]  # the step before counted as well
    assert begins.setpoint == STAND and begins.turning and begins.offset_m == 0.0
    assert begins.left_m == pytest.approx(math.dist(pose[:2], (1.0, 0.0)))


@pytest.mark.parametrize(("speed_mps", "arrives"), [(0.02, True), (0.04, False), (-0.04, False)])
def test_a_base_that_still_rolls_has_not_arrived(speed_mps: float, arrives: bool) -> None:
    follower = Follower(DrivePath((straight_leg((1.0, 0.0), (1.0, 0.01)),)), NavigationSettings())
    answers = [follower.step(k * 10**8, np.array([1.0, 0.01, 0.0]), speed_mps, 0.0) for k in range(SETTLED)]
    assert answers[-1].done == arrives


def test_a_goal_that_is_missed_three_times_is_given_up_with_the_distance() -> None:
    follower = Follower(drive_path([(0.0, 0.0), (1.0, 0.0)]), NavigationSettings())
    drives = 0
    for k in range(40):
        beyond_m = 0.05 if drives % 2 == 0 else -0.05  # past the end of the correction that is driven
        was_driving = follower.pursuit is not None
        following = follower.step(k * 10**8, np.array([1.0 + beyond_m, 0.0, 0.0]), 0.0, 0.0)
        drives += follower.pursuit is not None and not was_driving
        if following.done:
            break
    assert following.done and drives == CORRECTIONS and following.missed_m == pytest.approx(0.05)
