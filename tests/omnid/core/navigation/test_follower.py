"""Following of a path of several legs: a corner is cut where a detour has come to the next leg, and nowhere else."""

from __future__ import annotations

import numpy as np
import pytest

from omnid.core.navigation.follower import SKIP_M, Follower
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
