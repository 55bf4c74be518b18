"""In a closed loop: people are let pass, or the base goes around them, as around floor that was not seen."""

from __future__ import annotations

import math

import numpy as np
import pytest
from numpy.typing import NDArray

from calib import se3
from calib.se2_arrays import relative
from omnid.core.control.collision_monitor import UNKNOWN, ControllerScan, MovingPoint
from omnid.core.navigation.navigator import Navigator
from omnid.core.navigation.path import DrivePath, drive_path, goal_path, straight_leg
from omnid.core.navigation.requests import NavigationFrame, NavigationState
from omnid.core.navigation.settings import NavigationSettings
from omnid.core.navigation.situation import Situation
from omnid.core.navigation.surroundings import LARGEST_SIGMA_M, Surroundings, near_ends
from omnid.core.obstacles.moving_tracker import Arrivals, MovingObstacle, MovingTracker
from tests.omnid.core.navigation.driven_base import DrivenBase, Floor
from tests.omnid.core.navigation.test_planner import AZIMUTHS, OUTLINE, SETTINGS, BaseAmongBoxes, Boxes, clearance_m

Array = NDArray[np.float64]
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
        path = DrivePath((straight_leg((0.0, 0.0), (5.0, 0.0)),), 0.0)
        self.navigator.start(NavigationFrame.ODOM, [path], self.seen())

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
def test_a_person_who_has_passed_or_comes_later_costs_little_time(at_m: float, begins_s: float) -> None:
    base = BaseAmongPeople(4, (at_m, 1.9), (0.0, -0.9), begins_s)
    assert base.run(60).state is NavigationState.REACHED
    assert base.gap_m > 0.1 and base.t_s < 25.0


@pytest.mark.hazard("H18")
@pytest.mark.parametrize(("seed", "aside_m"), [(5, 0.3), (6, -0.2)])
def test_the_base_goes_around_a_person_who_comes_along_the_path(seed: int, aside_m: float) -> None:
    base = BaseAmongPeople(seed, (7.0, aside_m), (-0.4, 0.0), 1.0)
    assert base.run(60).state is NavigationState.REACHED
    assert base.gap_m > 0.1
    assert any(sample.navigation.state is NavigationState.AVOIDING for sample in base.samples)


@pytest.mark.hazard("H18")
def test_the_base_stops_when_a_person_walks_into_it() -> None:
    base = BaseAmongPeople(5, (7.0, 0.0), (-0.7, 0.0), 1.0)
    assert base.run(60).state is NavigationState.REACHED
    assert base.gap_m < 0 and base.contact_mps < 0.02


def test_the_base_follows_a_person_who_walks_ahead_more_slowly() -> None:
    base = BaseAmongPeople(6, (1.3, 0.0), (0.25, 0.0), 0.0)
    assert base.run(60).state is NavigationState.REACHED
    assert base.gap_m > 0.1


def moving(x_m: float, y_m: float, vx_mps: float, vy_mps: float) -> Surroundings:
    """Return somebody who moves where all is floor but a row of cells at x = 3 m."""
    rows = Floor(all_seen=True).grid(np.zeros(3), Boxes((3.0, -0.3, 3.1, 0.3)).scan(np.zeros(3)))
    return Surroundings(rows, [MovingObstacle(x_m, y_m, vx_mps, vy_mps, np.diag([4e-4, 4e-4, 1e-2, 1e-2]), RADIUS_M)])


@pytest.mark.hazard("H18")
@pytest.mark.parametrize(
    ("person", "blocks"),
    [
        ((1.6, 3.2, 0.0, -0.8), True),  # at the path when the base is
        ((3.0, 0.5, 0.0, -1.0), False),  # has passed when the base comes
        ((0.6, 3.9, 0.0, -1.0), False),  # comes when the base has passed
        ((2.0, 0.0, 0.0, 0.0), True),
        ((4.0, 0.0, -0.5, 0.0), True),
        ((-1.5, 0.0, -0.5, 0.0), False),
        ((3.0, 0.0, 0.0, 0.0), False),  # is the row of cells
    ],
)
def test_the_path_is_blocked_where_the_base_meets_somebody(
    person: tuple[float, float, float, float], blocks: bool
) -> None:
    path = straight_leg((0.0, 0.0), (2.5, 0.0)).xy
    around = moving(*person)
    assert math.isfinite(around.first_blocked_m(path, 0.1, 0, 0.4)) is blocks
    stands = float(around.distance_at(np.array([[3.0, 0.0]]))[0])
    assert stands > 1.0 if person[:2] == (3.0, 0.0) else stands < 0.1


@pytest.mark.hazard("H18")
def test_uncertainty_makes_room_up_to_a_limit() -> None:
    radius_m = [moving(0.0, 0.0, 0.3, 0.0).movers(round(s * 1e9))[0, 4] for s in (-2.0, 0.0, 9.0)]
    assert RADIUS_M < radius_m[0] < radius_m[1] <= radius_m[2] == pytest.approx(RADIUS_M + LARGEST_SIGMA_M)


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
        """occupied: probability of an object in each cell that no scan has shown to be free."""
        super().__init__(Navigator(settings), 1)
        self.occupied = occupied
        self.boxes, self.floor, self.around = patches, Floor(), None
        self.navigator.start(NavigationFrame.ODOM, [path or goal_path(self.pose, (5.0, 0.0), 0.0)], self.seen())

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
def test_a_drive_ends_with_the_reason_where_no_floor_is_seen_across_the_way() -> None:
    base = BaseAmongPatches(Boxes((2.4, -9.0, 2.7, 9.0)), settings=NavigationSettings(give_up_s=4.0, stuck_s=6.0))
    answer = base.run(150)
    assert answer.state is NavigationState.FAILED and " m are left" in answer.reason
    assert UNKNOWN in answer.reason or "led no nearer" in answer.reason
    assert 0.05 < clearance_m(base) < 0.6 and abs(base.v) < 0.01


def test_the_base_drives_towards_floor_that_is_not_seen_yet() -> None:
    """The end of the floor far ahead is no obstacle: more floor comes into view as the base drives."""
    base = BaseAmongPatches(Boxes())
    assert base.run(60).state is NavigationState.REACHED
    assert not any(sample.navigation.state is NavigationState.AVOIDING for sample in base.samples)


@pytest.mark.hazard("H31", "H32")
def test_the_base_backs_out_where_the_floor_beside_it_is_unknown() -> None:
    """Nose to the end of a dead end whose walls are nearer than the floor in view: only the floor behind was seen."""
    beside = Boxes((-0.6, 0.34, 0.9, 0.5), (-0.6, -0.5, 0.9, -0.34), (0.3, -0.4, 0.9, 0.4))
    base = BaseAmongPatches(beside)
    base.navigator.start(NavigationFrame.ODOM, [goal_path(base.pose, (-2.0, 1.5))], base.seen())
    assert base.run(60).state is NavigationState.REACHED
    inside = [sample for sample in base.samples if sample.pose[0] > -0.5]
    assert max(abs(float(sample.pose[2])) for sample in inside) < 0.2
