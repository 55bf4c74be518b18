"""Ways around obstacles in a closed loop: a scan of ranges as the cameras give it, boxes on and beside the path."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from omnid.core.control.collision_monitor import CollisionSettings, ControllerScan
from omnid.core.navigation.navigator import WAITS, Navigator
from omnid.core.navigation.path import DrivePath, drive_path, goal_path, straight_leg
from omnid.core.navigation.requests import NavigationFrame, NavigationState
from omnid.core.navigation.settings import NavigationSettings
from omnid.core.navigation.situation import Situation
from omnid.core.navigation.surroundings import Surroundings
from tests.omnid.core.navigation.driven_base import DrivenBase, Floor

Array = NDArray[np.float64]
AZIMUTHS = -math.pi + (np.arange(360) + 0.5) * math.tau / 360
SETTINGS = NavigationSettings()
OUTLINE = CollisionSettings()


class Boxes:
    """Boxes on the floor: x0, y0, x1, y1 [m]."""

    def __init__(self, *boxes: tuple[float, float, float, float]) -> None:
        self.boxes = np.array(boxes).reshape(-1, 4)

    def clearance_m(self, xy: Array) -> float:
        """Return the distance of a point to the nearest box."""
        if not len(self.boxes):
            return math.inf
        low, high = self.boxes[:, :2] - xy, xy - self.boxes[:, 2:]
        return float(np.hypot(*np.maximum(np.maximum(low, high), 0.0).T).min())

    def scan(self, pose: Array) -> Array:
        """Return ranges (360,) from a pose, inf beyond 4 m: slabs of the boxes."""
        directions = np.column_stack([np.cos(AZIMUTHS + pose[2]), np.sin(AZIMUTHS + pose[2])])
        if not len(self.boxes):
            return np.full(360, math.inf)
        with np.errstate(divide="ignore", invalid="ignore"):
            a = (self.boxes[:, None, :2] - pose[:2]) / directions
            b = (self.boxes[:, None, 2:] - pose[:2]) / directions
        enter, leave = np.minimum(a, b).max(axis=2), np.maximum(a, b).min(axis=2)
        hit = np.where((enter <= leave) & (enter > 0), enter, math.inf).min(axis=0)
        return np.where(hit < 4.0, hit, math.inf)


class BaseAmongBoxes(DrivenBase):
    """A base whose scan shows boxes."""

    boxes = Boxes()
    has_scan = True  # the collision monitor of the control law sees it, too

    def seen(self) -> Situation:
        now = super().seen()
        ranges = self.boxes.scan(self.pose) + self.rng.normal(0, 0.01, 360)
        self.law.take(ControllerScan(now.stamp_ns, tuple(ranges.tolist())))
        return now._replace(around=around(self.pose, ranges, now.stamp_ns))


def around(pose: Array, ranges_m: Array, stamp_ns: int = 0) -> Surroundings:
    """Return what a scan shows, where all else is floor."""
    return Surroundings(Floor(all_seen=True).grid(pose, ranges_m), (), stamp_ns, pose)


def drive(boxes: Boxes, seed: int, settings: NavigationSettings = SETTINGS, length_m: float = 5.0) -> BaseAmongBoxes:
    """Begin to drive straight on among boxes."""
    base = BaseAmongBoxes(Navigator(settings), seed)
    base.boxes = boxes
    path = DrivePath((straight_leg((0.0, 0.0), (length_m, 0.0)),), 0.0)
    base.navigator.start(NavigationFrame.ODOM, [path], base.seen())
    return base


def clearance_m(base: BaseAmongBoxes) -> float:
    """Return the smallest distance of the outline to a box."""
    return min(base.boxes.clearance_m(sample.pose[:2]) for sample in base.samples) - OUTLINE.half_width_m


@pytest.mark.hazard("H31")
@pytest.mark.parametrize(
    "boxes",
    [
        Boxes((2.5, -0.2, 2.9, 0.2)),
        Boxes((2.5, -1.2, 2.8, 0.1)),
        Boxes((2.5, -0.1, 2.8, 1.2)),
        Boxes((1.6, -0.6, 1.8, 0.3), (3.2, -0.3, 3.4, 0.6)),
        Boxes((2.0, -0.15, 3.2, 0.15)),
        Boxes((2.4, -0.2, 2.8, 0.2), (-1.0, 1.2, 7.0, 1.4), (-1.0, -1.4, 7.0, -1.2)),
    ],
)
def test_the_base_goes_around_boxes_and_reaches_the_goal(boxes: Boxes) -> None:
    base = drive(boxes, 1)
    assert base.run(90, rest_s=0.3).state is NavigationState.REACHED
    assert base.error((5.0, 0.0, 0.0))[0] < 0.03
    assert clearance_m(base) > 0.02
    assert any(sample.navigation.state is NavigationState.AVOIDING for sample in base.samples)
    offsets = [abs(float(sample.pose[1])) for sample in base.samples]
    assert max(offsets) < SETTINGS.corridor_m + 0.1


@pytest.mark.hazard("H31")
@pytest.mark.parametrize(
    "boxes",
    [
        Boxes((2.5, -3.0, 2.7, 3.0)),
        Boxes((2.5, -0.7, 2.7, 0.7), (1.5, 0.7, 2.7, 0.9), (1.5, -0.9, 2.7, -0.7)),
        Boxes((4.8, -0.2, 5.2, 0.2)),
    ],
)
def test_the_base_waits_without_a_way_and_gives_the_reason(boxes: Boxes) -> None:
    base = drive(boxes, 1)
    base.run(90, lambda answer: answer.state is NavigationState.BLOCKED)
    answer = base.run(2, lambda _: True, rest_s=6.0)
    answer = base.run(2, lambda _: True)
    assert answer.state is NavigationState.BLOCKED and answer.reason.endswith(WAITS)
    assert 0.05 < clearance_m(base) < 1.0
    assert abs(base.v) < 0.01


def test_the_base_drives_on_when_the_way_becomes_free() -> None:
    base = drive(Boxes((2.5, -3.0, 2.7, 3.0)), 2)
    base.run(60, lambda answer: answer.state is NavigationState.BLOCKED)
    base.boxes = Boxes()
    assert base.run(60).state is NavigationState.REACHED


def test_the_base_stays_on_the_path_without_a_corridor() -> None:
    base = drive(Boxes((2.5, -0.2, 2.9, 0.2)), 3, NavigationSettings(corridor_m=0.0))
    base.run(60, lambda answer: answer.state is NavigationState.BLOCKED, rest_s=20.0)
    assert base.samples[-1].navigation.state is NavigationState.BLOCKED
    assert max(abs(float(sample.pose[1])) for sample in base.samples) < 0.1


def test_walls_beside_the_path_change_nothing() -> None:
    base = drive(Boxes((-1.0, 0.6, 7.0, 0.8), (-1.0, -0.8, 7.0, -0.6)), 4)
    assert base.run(90).state is NavigationState.REACHED
    assert not any(sample.navigation.state is NavigationState.AVOIDING for sample in base.samples)


def test_a_base_that_begins_too_near_drives_away() -> None:
    base = drive(Boxes((-0.5, -0.4, 0.2, -0.32)), 5)
    assert base.run(60).state is NavigationState.REACHED


def test_the_plan_goes_around_a_box_behind_a_curve_and_a_corner() -> None:
    base = BaseAmongBoxes(Navigator(SETTINGS), 6)
    base.boxes = Boxes((2.8, 1.2, 3.2, 1.6))
    path = drive_path([(0.0, 0.0), (3.0, 0.0), (3.0, 3.0)], math.pi / 2)
    base.navigator.start(NavigationFrame.ODOM, [path], base.seen())
    assert base.run(90).state is NavigationState.REACHED
    assert clearance_m(base) > 0.02


DEAD_END = Boxes((0.75, -0.7, 0.85, 0.7), (-1.4, 0.6, 0.85, 0.7), (-3.3, -0.7, 0.85, -0.6), (-3.3, -0.7, -3.2, 3.6))
DOOR = Boxes((1.5, 0.4, 1.7, 4.0), (1.5, -4.0, 1.7, -0.4))
ROOM = Boxes((-2.2, -2.2, 2.2, -2.0), (-2.2, 2.0, 2.2, 2.2), (-2.2, -2.2, -2.0, 2.2), (2.0, -2.2, 2.2, 2.2))


def to_goal(boxes: Boxes, x_m: float, y_m: float, give_up_s: float = SETTINGS.give_up_s) -> BaseAmongBoxes:
    """Begin to drive to a goal, by any way."""
    base = BaseAmongBoxes(Navigator(replace(SETTINGS, give_up_s=give_up_s)), 1)
    base.boxes = boxes
    base.navigator.start(NavigationFrame.ODOM, [goal_path(base.pose, (x_m, y_m), 0.0)], base.seen())
    return base


@pytest.mark.hazard("H31")
@pytest.mark.parametrize(
    ("boxes", "goal"), [(DOOR, (4.0, 1.0)), (DEAD_END, (-2.3, 2.6)), (Boxes((1.5, -1.6, 1.7, 1.6)), (3.5, 0.0))]
)
def test_a_goal_is_reached_through_a_door_out_of_a_dead_end_and_around_a_wall(
    boxes: Boxes, goal: tuple[float, float]
) -> None:
    base = to_goal(boxes, *goal)
    assert base.run(90).state is NavigationState.REACHED
    assert base.error((*goal, 0.0))[0] < 0.03 and clearance_m(base) > 0.02


@pytest.mark.hazard("H31")
@pytest.mark.parametrize(
    ("goal", "reason"),
    [((4.0, 0.0), "closes every way"), ((30.0, 15.0), "closes every way"), ((2.1, 0.0), "from the goal")],
)
def test_a_goal_that_cannot_be_reached_ends_with_what_is_in_the_way(goal: tuple[float, float], reason: str) -> None:
    base = to_goal(ROOM, *goal, give_up_s=5.0)
    answer = base.run(60)
    assert answer.state is NavigationState.FAILED and base.t_s < 17.0
    assert answer.reason.startswith("no way to the goal, ") and reason in answer.reason
    assert clearance_m(base) > 0.02


def test_a_long_detour_begins_after_as_long_a_wait() -> None:
    wall = (2.5, -3.5, 2.7, -0.5), (2.5, 0.5, 2.7, 3.5)
    person = Boxes(*wall, (2.3, -0.3, 2.8, 0.3))
    for leaves in (True, False):
        base = to_goal(person, 5.0, 0.0)
        base.run(60, lambda answer: answer.state is NavigationState.BLOCKED, rest_s=3.0)
        assert abs(float(base.pose[1])) < 0.3, "it waits at the door"
        base.boxes = Boxes(*wall) if leaves else person
        assert base.run(90).state is NavigationState.REACHED
        aside_m = max(abs(float(sample.pose[1])) for sample in base.samples)
        assert aside_m < 0.3 if leaves else aside_m > 3.0
        assert clearance_m(base) > 0.0
