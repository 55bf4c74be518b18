"""Ways around boxes, people and floor that was not seen, in a closed loop with the collision monitor."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from calib import se3
from calib.se2_arrays import relative
from omnid.core.control.collision_monitor import UNKNOWN, CollisionSettings, ControllerScan, MovingPoint
from omnid.core.navigation.navigator import WAITS, Navigator
from omnid.core.navigation.path import drive_path
from omnid.core.navigation.planner import Surroundings
from omnid.core.navigation.requests import NavigationFrame
from omnid.core.navigation.settings import NavigationSettings
from omnid.core.navigation.situation import Situation
from omnid.core.obstacles.moving_tracker import Arrivals, MovingTracker
from omnid.navigation_state import NavigationState
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
    path = drive_path([(0.0, 0.0), (length_m, 0.0)], 0.0)
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
    answer = base.run(2, lambda _: True, rest_s=6.0)
    answer = base.run(2, lambda _: True)
    assert answer.state is NavigationState.BLOCKED and answer.reason.endswith(WAITS)
    assert 0.05 < clearance_m(base) < 1.0
    assert abs(base.v) < 0.01


def test_goes_on_when_the_way_becomes_free() -> None:
    base = drive(Boxes((2.5, -3.0, 2.7, 3.0)), 2)
    base.run(60, lambda answer: answer.state is NavigationState.BLOCKED)
    base.boxes = Boxes()
    assert base.run(60).state is NavigationState.REACHED


def test_without_a_corridor_it_stays_on_the_path() -> None:
    base = drive(Boxes((2.5, -0.2, 2.9, 0.2)), 3, NavigationSettings(corridor_m=0.0))
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


def test_goes_around_a_box_behind_a_curve_and_a_corner() -> None:
    base = BaseAmongBoxes(Navigator(SETTINGS), 6)
    base.boxes = Boxes((2.8, 1.2, 3.2, 1.6))
    path = drive_path([(0.0, 0.0), (3.0, 0.0), (3.0, 3.0)], math.pi / 2)
    base.navigator.start("path", NavigationFrame.ODOM, [path], base.seen())
    assert base.run(90).state is NavigationState.REACHED
    assert clearance_m(base) > 0.02


DEAD_END = Boxes((0.75, -0.7, 0.85, 0.7), (-1.4, 0.6, 0.85, 0.7), (-3.3, -0.7, 0.85, -0.6), (-3.3, -0.7, -3.2, 3.6))
DOOR = Boxes((1.5, 0.4, 1.7, 4.0), (1.5, -4.0, 1.7, -0.4))
ROOM = Boxes((-2.2, -2.2, 2.2, -2.0), (-2.2, 2.0, 2.2, 2.2), (-2.2, -2.2, -2.0, 2.2), (2.0, -2.2, 2.2, 2.2))


def to_goal(boxes: Boxes, x_m: float, y_m: float, give_up_s: float = SETTINGS.give_up_s) -> BaseAmongBoxes:
    """Begin to drive to a goal, by any way."""
    base = BaseAmongBoxes(Navigator(replace(SETTINGS, give_up_s=give_up_s)), 1)
    base.boxes = boxes
    base.navigator.start(
        "goal", NavigationFrame.ODOM, [drive_path([base.pose[:2], (x_m, y_m)], 0.0, is_goal=True)], base.seen()
    )
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


RADIUS_M = 0.2
CORRIDOR = Boxes((-2.0, 2.2, 9.0, 2.4), (-2.0, -2.4, 9.0, -2.2), (8.0, -3.0, 8.2, 3.0))
SCAN_S = 0.2


class BaseAmongPeople(BaseAmongBoxes):
    """A base whose scan shows a person who walks straight on from a time; the person does not look at the robot."""

    boxes = CORRIDOR

    def __init__(self, seed: int, start: tuple[float, float], velocity: tuple[float, float], begins_s: float) -> None:
        self.person, self.walk, self.begins_s = np.array(start), np.array(velocity), begins_s
        self.tracker, self.scan_s, self.moving = MovingTracker(), -math.inf, ()
        self.gap_m, self.contact_mps = math.inf, 0.0  # to the person; forward speed just before a contact ahead
        super().__init__(Navigator(SETTINGS), seed)
        path = drive_path([(0.0, 0.0), (5.0, 0.0)], 0.0)
        self.navigator.start("goal", NavigationFrame.ODOM, [path], self.seen())

    def where(self) -> Array:
        """Return the place of the person now."""
        return np.asarray(self.person + self.walk * max(0.0, self.t_s - self.begins_s))

    def tick(self):  # type: ignore[no-untyped-def]
        answer = super().tick()
        x, y = relative(self.pose, np.array([*self.where(), 0.0]))[:2]
        beside = max(abs(x) - OUTLINE.front_m, 0.0), max(abs(y) - OUTLINE.half_width_m, 0.0)
        gap_m = math.hypot(*beside) - RADIUS_M
        if 0.0 <= gap_m < 0.05 and x > 0:
            self.contact_mps = max(self.contact_mps, self.v)
        self.gap_m = min(self.gap_m, gap_m)
        return answer

    def seen(self) -> Situation:
        now = super().seen()
        directions = np.column_stack([np.cos(AZIMUTHS + self.pose[2]), np.sin(AZIMUTHS + self.pose[2])])
        to = self.where() - self.pose[:2]
        along = directions @ to
        left2 = RADIUS_M**2 - (to @ to - along**2)
        person = np.where((left2 > 0) & (along > 0), along - np.sqrt(np.maximum(left2, 0)), math.inf)
        walls = self.boxes.scan(self.pose)
        ranges = np.minimum(walls, person) + self.rng.normal(0, 0.01, 360)
        if self.t_s - self.scan_s >= SCAN_S - 1e-6:
            self.scan_s = self.t_s
            T = se3.transform(se3.rotation_exp([0, 0, self.pose[2]]), [*self.pose[:2], 0.0])
            self.moving = self.tracker.update(
                now.stamp_ns,
                T,
                Arrivals(np.where(person < walls, ranges, math.nan), np.full(360, 0.01), np.zeros(360, bool)),
            )
            points = tuple(
                MovingPoint(
                    *relative(self.pose, np.array([m.x_m, m.y_m, 0.0]))[:2].tolist(),
                    *(T[:2, :2].T @ (m.vx_mps, m.vy_mps)).tolist(),
                    m.radius_m,
                    *(math.sqrt(np.diag(m.covariance)[part].max()) for part in (slice(2), slice(2, 4))),
                )
                for m in self.moving
            )
            self.law.take(ControllerScan(now.stamp_ns, tuple(ranges.tolist()), moving=points))
        grid = Floor(all_seen=True).grid(self.pose, ranges)
        return now._replace(around=Surroundings(grid, self.moving, round(self.scan_s * 1e9), self.pose))


@pytest.mark.hazard("H18")
def test_a_person_who_crosses_is_let_pass_without_contact() -> None:
    for seed, side in ((1, 1), (2, -1)):
        base = BaseAmongPeople(seed, (2.6, side * 1.9), (0.0, -side * 0.8), 2.6)
        assert base.run(60).state is NavigationState.REACHED
        assert base.gap_m > 0.1, seed
        assert base.t_s < 30.0


@pytest.mark.hazard("H18")
@pytest.mark.parametrize(("at_m", "begins_s"), [(4.6, 0.5), (3.4, 2.6), (3.4, 3.8), (1.2, 5.0)])
def test_who_has_passed_before_or_comes_after_costs_little_time(at_m: float, begins_s: float) -> None:
    base = BaseAmongPeople(4, (at_m, 1.9), (0.0, -0.9), begins_s)
    assert base.run(60).state is NavigationState.REACHED
    assert base.gap_m > 0.1 and base.t_s < 25.0


@pytest.mark.hazard("H18")
@pytest.mark.parametrize(("seed", "aside_m"), [(5, 0.3), (6, -0.2)])
def test_goes_around_a_person_who_comes_along_the_path(seed: int, aside_m: float) -> None:
    base = BaseAmongPeople(seed, (7.0, aside_m), (-0.4, 0.0), 1.0)
    assert base.run(60).state is NavigationState.REACHED
    assert base.gap_m > 0.1
    assert any(sample.navigation.state is NavigationState.AVOIDING for sample in base.samples)


@pytest.mark.hazard("H18")
def test_stands_when_a_person_walks_into_it() -> None:
    base = BaseAmongPeople(5, (7.0, 0.0), (-0.7, 0.0), 1.0)
    assert base.run(60).state is NavigationState.REACHED
    assert base.gap_m < 0 and base.contact_mps < 0.02


def test_follows_a_person_who_walks_ahead_more_slowly() -> None:
    base = BaseAmongPeople(6, (1.3, 0.0), (0.25, 0.0), 0.0)
    assert base.run(60).state is NavigationState.REACHED
    assert base.gap_m > 0.1


SEEN_M = 2.0  # Floor is seen so far.


class BaseAmongPatches(DrivenBase):
    """A base whose scan shows floor up to patches that are unknown, and nothing that stands there."""

    has_scan = True

    def __init__(
        self,
        patches: Boxes,
        path: bool = False,
        occupied: float = math.nan,
        settings: NavigationSettings = SETTINGS,
    ) -> None:
        """occupied: probability of a thing in each cell that no scan has shown to be free."""
        super().__init__(Navigator(settings), 1)
        self.occupied = occupied
        self.boxes, self.floor, self.around = patches, Floor(), None
        self.navigator.start(
            "goal", NavigationFrame.ODOM, [drive_path([self.pose[:2], (5.0, 0.0)], 0.0, is_goal=not path)], self.seen()
        )

    def seen(self) -> Situation:
        now = super().seen()
        free_m, ranges_m = np.minimum(self.boxes.scan(self.pose), SEEN_M), np.full(360, np.inf)
        self.law.take(ControllerScan(now.stamp_ns, tuple(ranges_m.tolist()), tuple(free_m.tolist())))
        grid = self.floor.grid(self.pose, ranges_m, free_m)
        grid.occupied[np.isnan(grid.occupied)] = self.occupied
        self.around = Surroundings(grid, (), now.stamp_ns, self.pose, self.around)
        return now._replace(around=self.around)


@pytest.mark.hazard("H31")
@pytest.mark.parametrize(
    ("path", "occupied"),
    [(False, math.nan), (True, 0.05)],
    ids=["goal, unknown", "path, each cell free"],
)
def test_a_patch_that_closes_the_way_is_passed_beside_it(path: bool, occupied: float) -> None:
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
    base.navigator.start(
        "goal", NavigationFrame.ODOM, [drive_path([base.pose[:2], (-2.0, 1.5)], None, is_goal=True)], base.seen()
    )
    assert base.run(60).state is NavigationState.REACHED
    inside = [sample for sample in base.samples if sample.pose[0] > -0.5]
    assert max(abs(float(sample.pose[2])) for sample in inside) < 0.2
