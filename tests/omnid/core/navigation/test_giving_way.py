"""A blocked base drives back to let others pass, comes again, and goes on by itself: in a closed loop."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
import pytest

from omnid.core.navigation.navigator import GIVES_WAY, Navigation, Navigator
from omnid.core.navigation.path import DrivePath, drive_path, straight_leg
from omnid.core.navigation.requests import NavigationFrame
from omnid.core.navigation.settings import NavigationSettings
from omnid.core.navigation.situation import Situation
from omnid.navigation_state import NavigationState
from tests.omnid.core.navigation.test_planner import BaseAmongBoxes, Boxes, clearance_m

SETTINGS = NavigationSettings()
DOOR = ((2.4, 0.45, 2.6, 4.0), (2.4, -4.0, 2.6, -0.45))
CORRIDOR = ((-3.0, 0.6, 8.0, 0.8), (-3.0, -0.8, 8.0, -0.6))
Box = tuple[float, float, float, float]


def person(x_m: float, y_m: float) -> Box:
    return x_m - 0.2, y_m - 0.2, x_m + 0.2, y_m + 0.2


class BaseAmongOthers(BaseAmongBoxes):
    """A base among walls and one box that moves as the test says."""

    def __init__(
        self,
        walls: tuple[Box, ...],
        other: Callable[[BaseAmongOthers], Box | None],
        seed: int,
        settings: NavigationSettings = SETTINGS,
        path: DrivePath | None = None,
    ) -> None:
        self.walls, self.other = walls, other
        super().__init__(Navigator(settings), seed)
        path = path or DrivePath((straight_leg((0.0, 0.0), (5.0, 0.0)),), 0.0)
        self.navigator.start("goal", NavigationFrame.ODOM, [path], self.seen())

    def seen(self) -> Situation:
        other = self.other(self)
        self.boxes = Boxes(*self.walls, *([other] if other else []))
        return super().seen()

    @property
    def states(self) -> list[NavigationState]:
        return [sample.navigation.state for sample in self.samples]

    def began_to_give_way(self) -> list[float]:
        """Return the times at which it began to drive back."""
        gives = [sample.navigation.reason == GIVES_WAY for sample in self.samples]
        return [
            sample.t_s
            for before, now, sample in zip([False, *gives], gives, self.samples, strict=False)
            if now and not before
        ]


class Walker:
    """A person who stands in a door until the robot has left it, and then walks through and aside."""

    def __init__(self) -> None:
        self.way = [(2.7, 0.0)] + [(2.7 - 0.02 * k, 0.0) for k in range(60)] + [(1.5, 0.02 * k) for k in range(90)]
        self.step, self.met = 0, False

    def __call__(self, base: BaseAmongOthers) -> Box:
        away_m = math.dist(base.pose[:2], self.way[0])
        self.met = self.met or away_m < 1.4
        if self.step or (self.met and away_m > 2.0):
            self.step = min(self.step + 1, len(self.way) - 1)
        return person(*self.way[self.step])


def test_somebody_who_waits_in_a_door_is_let_through() -> None:
    base = BaseAmongOthers(DOOR, Walker(), 1)
    assert base.run(120).state is NavigationState.REACHED
    assert len(base.began_to_give_way()) == 1 and NavigationState.BLOCKED in base.states
    assert clearance_m(base) > 0.02


def test_what_stands_there_for_good_is_looked_at_again_and_again_more_rarely() -> None:
    gone = [False]
    base = BaseAmongOthers(CORRIDOR, lambda _: None if gone[0] else person(3.0, 0.0), 4)

    def waits(answer: Navigation) -> bool:
        assert not answer.state.is_end
        return base.t_s > 120

    base.run(130, waits)
    first_s, second_s, third_s = base.began_to_give_way()
    assert third_s - second_s > second_s - first_s + 5.0, "the waits become longer"
    assert clearance_m(base) > 0.02 and min(float(sample.pose[0]) for sample in base.samples) > -0.2
    driving = [sample.navigation for sample in base.samples if sample.navigation.state is NavigationState.DRIVING]
    assert all(answer.setpoint is not None and answer.setpoint.velocity_mps >= 0 for answer in driving), "face ahead"
    gone[0] = True
    assert base.run(120).state is NavigationState.REACHED


@pytest.mark.hazard("H32")
def test_goes_back_only_as_far_as_it_is_free() -> None:
    """Somebody has come behind the base: it never comes near."""
    behind_m = 0.8
    base = BaseAmongOthers(
        (*CORRIDOR, person(3.0, 0.0)), lambda base: person(behind_m, 0.0) if base.t_s > 10.0 else None, 5
    )
    base.run(60, lambda _: base.t_s > 35)
    later = [float(sample.pose[0]) for sample in base.samples if sample.t_s > 10.0]
    assert min(later) > behind_m + 0.2 + 0.2, "outline of both"
    assert max(later) - min(later) > 0.15, "it did go back a little"


def test_stays_where_it_is_blocked_if_that_is_wanted() -> None:
    base = BaseAmongOthers((*CORRIDOR, person(3.0, 0.0)), lambda _: None, 6, NavigationSettings(give_way_m=0.0))
    base.run(60, lambda _: base.t_s > 30)
    assert not base.began_to_give_way() and base.states[-1] is NavigationState.BLOCKED


def test_stops_at_the_next_place_where_others_can_pass() -> None:
    """The corridor begins at x = 2 m: before it there is room."""
    corridor = ((2.0, 0.5, 8.0, 0.7), (2.0, -0.7, 8.0, -0.5))
    base = BaseAmongOthers((*corridor, person(3.6, 0.0)), lambda _: None, 7)
    base.run(60, lambda _: bool(base.began_to_give_way()) and base.states[-1] is NavigationState.BLOCKED)
    assert 0.6 < base.pose[0] < 1.6, "out of the corridor, and no farther"


def test_goes_back_around_a_corner_and_comes_again() -> None:
    path = drive_path([(0.0, 0.0), (1.5, 0.0), (1.5, 4.0)])
    gone = [False]
    base = BaseAmongOthers(
        ((2.05, -0.6, 2.25, 5.0), (0.75, 0.7, 0.95, 5.0)), lambda _: None if gone[0] else person(1.5, 2.2), 8, path=path
    )
    base.run(90, lambda _: bool(base.began_to_give_way()) and base.states[-1] is NavigationState.BLOCKED)
    assert base.pose[1] < 0.3 and base.pose[0] < 1.2, "round the corner"
    gone[0] = True
    assert base.run(90).state is NavigationState.REACHED
    x, y, _ = np.array([sample.pose for sample in base.samples]).T
    assert np.minimum(abs(y), abs(x - 1.5)).max() < 0.25, "it never leaves its path"
    assert clearance_m(base) > 0.02


@pytest.mark.hazard("H32")
def test_fails_where_it_is_taken_away_while_it_gives_way() -> None:
    base = BaseAmongOthers((), lambda _: person(3.0, 0.0), 9, NavigationSettings(corridor_m=0.0))
    base.run(60, lambda answer: answer.reason == GIVES_WAY, rest_s=0.5)
    base.pose = base.pose + np.array([0.0, 2.0, 0.0])
    answer = base.run(10)
    assert answer.state is NavigationState.FAILED and "2.0 m beside the path" in answer.reason
