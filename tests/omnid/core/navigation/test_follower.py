"""Following of a path of several legs: a corner is cut where a detour has come to the next leg, and nowhere else."""

from __future__ import annotations

import numpy as np
import pytest

from omnid.core.navigation.follower import SETTLED, SKIP_M, Follower, Following
from omnid.core.navigation.path import drive_path
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


def test_the_last_leg_is_not_left() -> None:
    follower = Follower(drive_path(CORNER), NavigationSettings(), leg=1)
    follower.skip_corner(np.array([2.0, 2.0, 0.0]))
    assert follower.leg_left_m == pytest.approx(3.0)


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
    assert standing(follower, (1.0, 0.0, 0.0))[-1].done
