"""Patches of floor that were not seen: the collision monitor stops the base before them, and it goes around them."""

from __future__ import annotations

import numpy as np

from omnid.core.control.collision_monitor import UNKNOWN, ControllerRing, unknown_ends
from omnid.core.navigation.navigator import Navigator
from omnid.core.navigation.path import DrivePath, straight_leg
from omnid.core.navigation.requests import NavigationFrame
from omnid.core.navigation.situation import Situation
from omnid.navigation_state import NavigationState
from tests.omnid.core.navigation.driven_base import DrivenBase
from tests.omnid.core.navigation.test_planner import AZIMUTHS, OUTLINE, SETTINGS, Boxes, clearance_m

SEEN_M = 2.0  # Floor is seen so far.


class BaseAmongPatches(DrivenBase):
    """A base whose ring shows floor up to patches that are unknown, and nothing that stands there."""

    has_ring = True

    def __init__(self, patches: Boxes) -> None:
        super().__init__(Navigator(SETTINGS), 1)
        self.boxes = patches
        path = DrivePath((straight_leg((0.0, 0.0), (5.0, 0.0)),), 0.0)
        self.navigator.start("goal", NavigationFrame.ODOM, [path], self.seen())

    def seen(self) -> Situation:
        now = super().seen()
        free_m = np.minimum(self.boxes.ring(self.pose), SEEN_M)
        ranges_m = np.full(360, np.inf)
        self.law.take(ControllerRing(now.stamp_ns, tuple(ranges_m.tolist()), tuple(free_m.tolist())))
        near = [end.sector for end in unknown_ends(ranges_m.tolist(), free_m.tolist(), OUTLINE.stop_m)]
        near = [k for k in near if free_m[k] < 1.2]
        angles = AZIMUTHS[near] + self.pose[2]
        ends = self.pose[:2] + free_m[near, None] * np.column_stack([np.cos(angles), np.sin(angles)])
        return now._replace(obstacles=np.zeros((0, 2)), unknown=ends)


def test_a_patch_that_stays_unknown_is_passed_beside_it() -> None:
    base = BaseAmongPatches(Boxes((2.4, -0.15, 2.7, 0.2)))
    assert base.run(90, rest_s=0.3).state is NavigationState.REACHED
    answers = [sample.navigation for sample in base.samples]
    assert any(UNKNOWN in answer.reason for answer in answers), "it was stopped first"
    assert any(answer.state is NavigationState.AVOIDING for answer in answers)
    assert clearance_m(base) > 0.0


def test_where_no_floor_is_seen_across_the_way_the_base_waits_and_says_so() -> None:
    base = BaseAmongPatches(Boxes((2.4, -3.0, 2.7, 3.0)))
    base.run(30, lambda answer: answer.state is NavigationState.BLOCKED, rest_s=5.0)
    answer = base.samples[-1].navigation
    assert answer.state is NavigationState.BLOCKED and UNKNOWN in answer.reason
    assert 0.05 < clearance_m(base) < 0.6 and abs(base.v) < 0.01


def test_the_base_drives_towards_floor_that_is_not_seen_yet() -> None:
    """The end of the floor far ahead is no obstacle: more floor comes into view as the base drives."""
    base = BaseAmongPatches(Boxes())
    assert base.run(60).state is NavigationState.REACHED
    assert not any(sample.navigation.state is NavigationState.AVOIDING for sample in base.samples)
