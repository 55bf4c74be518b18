"""Patches of floor that were not seen: the collision monitor stops the base before them, and it goes around them."""

from __future__ import annotations

import math

import numpy as np
import pytest

from omnid.core.control.collision_monitor import UNKNOWN, ControllerScan
from omnid.core.navigation.navigator import Navigator
from omnid.core.navigation.path import DrivePath, drive_path, goal_path
from omnid.core.navigation.requests import NavigationFrame
from omnid.core.navigation.settings import NavigationSettings
from omnid.core.navigation.situation import Situation
from omnid.core.navigation.surroundings import Surroundings, near_ends
from omnid.navigation_state import NavigationState
from tests.omnid.core.navigation.driven_base import DrivenBase, Floor
from tests.omnid.core.navigation.test_planner import OUTLINE, SETTINGS, Boxes, clearance_m

SEEN_M = 2.0  # Floor is seen so far.


class BaseAmongPatches(DrivenBase):
    """A base whose scan shows floor up to patches that are unknown, and nothing that stands there."""

    has_scan = True

    def __init__(
        self,
        patches: Boxes,
        path: DrivePath | None = None,
        occupied: float = math.nan,
        settings: NavigationSettings = SETTINGS,
    ) -> None:
        """occupied: probability of a thing in each cell that no scan has shown to be free."""
        super().__init__(Navigator(settings), 1)
        self.occupied = occupied
        self.boxes, self.floor, self.around = patches, Floor(), None
        self.navigator.start("goal", NavigationFrame.ODOM, [path or goal_path(self.pose, (5.0, 0.0), 0.0)], self.seen())

    def seen(self) -> Situation:
        now = super().seen()
        free_m, ranges_m = np.minimum(self.boxes.scan(self.pose), SEEN_M), np.full(360, np.inf)
        self.law.take(ControllerScan(now.stamp_ns, tuple(ranges_m.tolist()), tuple(free_m.tolist())))
        grid = self.floor.grid(self.pose, ranges_m, free_m)
        grid.occupied[np.isnan(grid.occupied)] = self.occupied
        ends = near_ends(self.pose, ranges_m, free_m, OUTLINE)
        self.around = Surroundings(grid, (), now.stamp_ns, self.pose, self.around, ends)
        return now._replace(around=self.around)


@pytest.mark.hazard("H31")
@pytest.mark.parametrize(
    ("path", "occupied"),
    [(None, math.nan), (drive_path([(0.0, 0.0), (5.0, 0.0)], 0.0), 0.05)],
    ids=["goal, unknown", "path, each cell free"],
)
def test_a_patch_that_closes_the_way_is_passed_beside_it(path: DrivePath | None, occupied: float) -> None:
    """Its cells are unknown, or each of them is free and only a way across them has more than the risk."""
    base = BaseAmongPatches(Boxes((2.4, -0.15, 2.7, 0.2)), path, occupied)
    assert base.run(90, rest_s=0.3).state is NavigationState.REACHED
    assert any(sample.navigation.state is NavigationState.AVOIDING for sample in base.samples)
    assert clearance_m(base) > 0.0


@pytest.mark.hazard("H31")
def test_where_no_floor_is_seen_across_the_way_the_drive_ends_and_says_so() -> None:
    base = BaseAmongPatches(Boxes((2.4, -9.0, 2.7, 9.0)), settings=NavigationSettings(give_up_s=4.0, stuck_s=6.0))
    answer = base.run(150)
    assert answer.state is NavigationState.FAILED and " m are left" in answer.reason
    assert UNKNOWN in answer.reason or "ways were tried" in answer.reason
    assert 0.05 < clearance_m(base) < 0.6 and abs(base.v) < 0.01


def test_the_base_drives_towards_floor_that_is_not_seen_yet() -> None:
    """The end of the floor far ahead is no obstacle: more floor comes into view as the base drives."""
    base = BaseAmongPatches(Boxes())
    assert base.run(60).state is NavigationState.REACHED
    assert not any(sample.navigation.state is NavigationState.AVOIDING for sample in base.samples)


@pytest.mark.hazard("H31", "H32")
def test_does_not_turn_where_the_floor_beside_it_is_unknown_and_backs_out() -> None:
    """Nose to the end of a dead end whose walls are nearer than the floor in view: only the floor behind was seen."""
    beside = Boxes((-0.6, 0.34, 0.9, 0.5), (-0.6, -0.5, 0.9, -0.34), (0.3, -0.4, 0.9, 0.4))
    base = BaseAmongPatches(beside)
    base.navigator.start("goal", NavigationFrame.ODOM, [goal_path(base.pose, (-2.0, 1.5))], base.seen())
    assert base.run(60).state is NavigationState.REACHED
    inside = [sample for sample in base.samples if sample.pose[0] > -0.5]
    assert max(abs(float(sample.pose[2])) for sample in inside) < 0.2
