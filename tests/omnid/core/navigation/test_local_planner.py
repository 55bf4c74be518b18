"""Ways around obstacles in a closed loop: a ring of ranges as the cameras give it, boxes on and beside the path."""

from __future__ import annotations

import math

import numpy as np
import pytest
from numpy.typing import NDArray

from calib.se2_arrays import composed, predicted, relative
from omnid.core.control.collision_monitor import CollisionSettings, ControllerRing
from omnid.core.control.heading_controller import Setpoint
from omnid.core.navigation.forecast import forecast
from omnid.core.navigation.local_planner import ARC_S, ARC_STEPS, MARGIN_M, NEARER_M, LocalPlanner
from omnid.core.navigation.navigator import WAITS, Navigator
from omnid.core.navigation.path import DrivePath, drive_path, straight_leg
from omnid.core.navigation.requests import NavigationFrame
from omnid.core.navigation.settings import NavigationSettings, PursuitSettings
from omnid.core.navigation.situation import Situation
from omnid.core.obstacles.moving_tracker import MovingObstacle
from omnid.navigation_state import NavigationState
from tests.omnid.core.navigation.driven_base import DrivenBase

Array = NDArray[np.float64]
AZIMUTHS = -math.pi + (np.arange(360) + 0.5) * math.tau / 360
SETTINGS = NavigationSettings(give_way_m=0.0)
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

    def ring(self, pose: Array) -> Array:
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
    """A base whose ring shows boxes."""

    boxes = Boxes()
    has_ring = True  # the collision monitor of the control law sees it, too

    def seen(self) -> Situation:
        now = super().seen()
        ranges = self.boxes.ring(self.pose) + self.rng.normal(0, 0.01, 360)
        seen = np.isfinite(ranges)
        points = (
            self.pose[:2]
            + (ranges * np.array([np.cos(AZIMUTHS + self.pose[2]), np.sin(AZIMUTHS + self.pose[2])])).T[seen]
        )
        self.law.take(ControllerRing(now.stamp_ns, tuple(ranges.tolist())))
        near_m = float(ranges[seen & (np.abs(AZIMUTHS) < 1.7)].min(initial=math.inf)) - OUTLINE.half_width_m
        return now._replace(obstacles=points, obstacle_m=near_m)


def drive(boxes: Boxes, seed: int, settings: NavigationSettings = SETTINGS, length_m: float = 5.0) -> BaseAmongBoxes:
    """Begin to drive straight on among boxes."""
    base = BaseAmongBoxes(Navigator(settings), seed)
    base.boxes = boxes
    path = DrivePath((straight_leg((0.0, 0.0), (length_m, 0.0)),), 0.0)
    base.navigator.start("goal", NavigationFrame.ODOM, [path], base.seen())
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
def test_goes_around_boxes_and_reaches_the_goal(boxes: Boxes) -> None:
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
def test_waits_where_there_is_no_way_and_says_so(boxes: Boxes) -> None:
    base = drive(boxes, 1)
    base.run(90, lambda answer: answer.state is NavigationState.BLOCKED)
    for _ in range(15):
        answer = base.run(2, lambda _: True, rest_s=1.0)
    assert answer.state is NavigationState.BLOCKED and answer.reason.endswith(WAITS)
    assert 0.05 < clearance_m(base) < 1.0
    assert abs(base.v) < 0.01


def test_goes_on_when_the_way_becomes_free() -> None:
    base = drive(Boxes((2.5, -3.0, 2.7, 3.0)), 2)
    base.run(60, lambda answer: answer.state is NavigationState.BLOCKED)
    base.boxes = Boxes()
    assert base.run(60).state is NavigationState.REACHED


def test_without_a_corridor_it_stays_on_the_path() -> None:
    base = drive(Boxes((2.5, -0.2, 2.9, 0.2)), 3, NavigationSettings(give_way_m=0.0, corridor_m=0.0))
    base.run(60, lambda answer: answer.state is NavigationState.BLOCKED, rest_s=20.0)
    assert base.samples[-1].navigation.state is NavigationState.BLOCKED
    assert max(abs(float(sample.pose[1])) for sample in base.samples) < 0.1


def test_walls_beside_the_path_change_nothing() -> None:
    base = drive(Boxes((-1.0, 0.6, 7.0, 0.8), (-1.0, -0.8, 7.0, -0.6)), 4)
    assert base.run(90).state is NavigationState.REACHED
    assert not any(sample.navigation.state is NavigationState.AVOIDING for sample in base.samples)


def test_a_base_that_stands_too_near_drives_away() -> None:
    base = drive(Boxes((-0.5, -0.4, 0.2, -0.32)), 5)
    assert base.run(60).state is NavigationState.REACHED


def test_a_thing_that_the_base_leaves_hides_no_other_on_its_path() -> None:
    path = np.column_stack([np.arange(0, 4, 0.05), np.zeros(80)])
    beside, ahead = np.array([[-0.1, 0.3]]), np.array([[1.0, y] for y in np.linspace(-0.3, 0.3, 13)])
    both = LocalPlanner(SETTINGS, OUTLINE).plan(np.zeros(3), path, np.vstack([beside, ahead]), Setpoint(0.4))
    assert both.avoiding
    alone = LocalPlanner(SETTINGS, OUTLINE).plan(np.zeros(3), path, beside, Setpoint(0.4))
    assert not alone.avoiding and alone.setpoint == Setpoint(0.4)


def test_goes_around_a_box_behind_a_curve_and_a_corner() -> None:
    base = BaseAmongBoxes(Navigator(SETTINGS), 6)
    base.boxes = Boxes((2.8, 1.2, 3.2, 1.6))
    path = drive_path([(0.0, 0.0), (3.0, 0.0), (3.0, 3.0)], math.pi / 2)
    base.navigator.start("path", NavigationFrame.ODOM, [path], base.seen())
    assert base.run(90).state is NavigationState.REACHED
    assert clearance_m(base) > 0.02


def arcs(planner: LocalPlanner) -> tuple[Array, Array]:
    """Return the speeds and yaw rates (A, 2) of the arcs and places (A, T, 3) on them, of a base at the origin."""
    motions = np.column_stack([planner._v, planner._w])
    times = np.linspace(0.0, ARC_S, ARC_STEPS + 1)
    return motions, np.array([[predicted(np.zeros(3), v, w, t) for t in times] for v, w in motions])


def touches(motion: Array, places: Array, obstacle: Array) -> bool:
    """True if an obstacle (2,) comes into the room that the collision monitor demands at places (T, 3) of an arc."""
    front_m = OUTLINE.front_m + (OUTLINE.stop_m if motion[0] > 0 else 0.0) + MARGIN_M
    rear_m = OUTLINE.rear_m + (OUTLINE.stop_m if motion[0] < 0 else 0.0) + MARGIN_M
    x, y = np.array([relative(place, np.array([*obstacle, 0.0]))[:2] for place in places]).T
    return bool(((-rear_m < x) & (x < front_m) & (abs(y) < OUTLINE.half_width_m + OUTLINE.side_m + MARGIN_M)).any())


@pytest.mark.parametrize(("velocity_mps", "heading"), [(0.4, 0.0), (0.4, 2.2), (1.0, math.pi / 2)])
def test_arcs_keep_the_room_that_the_collision_monitor_demands(velocity_mps: float, heading: float) -> None:
    planner = LocalPlanner(NavigationSettings(pursuit=PursuitSettings(velocity_mps=velocity_mps)), OUTLINE)
    motions, places = arcs(planner)
    pose = np.array([3.0, -1.0, heading])
    for obstacle in ((0.43, 0.1), (-0.3, 0.1), (-0.43, -0.2), (0.2, 0.4), (0.6, 0.5), (1.45, 0.0)):
        seen = composed(pose[None], np.array([*obstacle, 0.0]))[:, :2]
        expected = [not touches(motion, arc, np.array(obstacle)) for motion, arc in zip(motions, places, strict=True)]
        np.testing.assert_array_equal(planner._keeps_clear(pose, seen), expected)


@pytest.mark.parametrize(("x_m", "sign"), [(0.26, 1.0), (-0.26, -1.0)])
def test_an_obstacle_at_the_outline_may_be_left_but_not_approached(x_m: float, sign: float) -> None:
    planner = LocalPlanner(SETTINGS, OUTLINE)
    may = planner._keeps_clear(np.zeros(3), np.array([[x_m, 0.0]]))
    straight = planner._w == 0
    towards = sign * planner._v > 0
    assert not may[straight & towards].any()
    assert may[straight & (sign * planner._v < 0)].all()


def test_arcs_keep_clear_of_somebody_who_walks_at_each_moment() -> None:
    planner = LocalPlanner(SETTINGS, OUTLINE)
    _, places = arcs(planner)
    P = np.diag([1e-4, 1e-4, 1e-4, 1e-4])
    moving = forecast([MovingObstacle(0.7, 0.9, 0.0, -0.4, P, 0.2), MovingObstacle(-0.6, 0.1, 0.1, 0.0, P, 0.2)], 0.0)
    assert moving is not None
    others, radii = moving.at(np.linspace(0.0, ARC_S, ARC_STEPS + 1))
    away_m = np.hypot(*np.moveaxis(places[None, :, :, :2] - others[:, None], -1, 0))
    room_m = radii[:, None] + OUTLINE.half_width_m + OUTLINE.side_m - NEARER_M
    expected = (away_m >= room_m).all(axis=(0, 2))
    assert 0.1 < expected.mean() < 0.9
    np.testing.assert_array_equal(planner._lets_pass(places[..., :2], moving), expected)
