"""Scans by the posterior of rays: plain floor is free, what stands on it is not, and what is not seen is not free."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

import numpy as np
import pytest

from calib import se3
from omnid.core.mapping.range_scan import azimuths
from omnid.core.obstacles.grid import CELL_M, OCCUPIED, GridScan
from omnid.core.obstacles.ray_scans import RayScans
from omnid.core.obstacles.settings import ScanSettings
from tests.omnid.core.obstacles.drawn_floor import (
    BASELINE_M,
    CYLINDER,
    T_RECT_BASE,
    Bar,
    Block,
    Obstacle,
    Pattern,
    Pole,
    Slope,
    Walls,
    panoramas,
    plain,
    stains,
    striped,
    worn,
    worn_with_line,
)

WALL_M = 3.0
PAIRS, PERIOD_NS = 5, 100_000_000
AHEAD, BEHIND = np.abs(azimuths()) < math.radians(1.5), np.abs(azimuths()) > math.radians(90)
SHOWN = np.ones((CYLINDER.height, CYLINDER.width), bool)


class BaseAtRest:
    """A base at rest, in the middle of a round room."""

    def __init__(self, floor: Pattern, visible: np.ndarray = SHOWN, ahead_m: float = 0.0) -> None:
        """ahead_m: of the cameras before the origin of the base."""
        self.floor, self.seq = floor, 0
        self.scans = RayScans(CYLINDER, BASELINE_M, ScanSettings())
        self.scans.set_floor(T_RECT_BASE @ se3.transform(np.eye(3), [-ahead_m, 0.0, 0.0]), visible)

    def scan(
        self,
        obstacle: Obstacle | None = None,
        *,
        pairs: int = 1,
        wall_m: float = WALL_M,
        wall: Pattern = striped,
        drop_m: float = 0.0,
        lost: np.ndarray | None = None,
        at_m: float = 0.0,
    ) -> GridScan:
        """Return the scan after some more pairs; at_m: how far the base has come."""
        pose = se3.transform(np.eye(3), [at_m, 0.0, 0.0])
        for _ in range(pairs):
            lower, upper = panoramas(self.floor, wall_m, wall, drop_m, obstacle, seed=self.seq)
            scan = self.scans.add(self.seq * PERIOD_NS, pose, lower, upper, lost)
            self.seq += 1
        assert scan is not None
        return scan


def jointed(floor: Pattern, joint_m: float, x_m: np.ndarray, y_m: np.ndarray) -> np.ndarray:
    """Return grey levels of a floor with a dark joint of 2 cm around the base."""
    return np.where(np.abs(np.hypot(x_m, y_m) - joint_m) < 0.01, 100.0, floor(x_m, y_m))


def without_a_quarter() -> np.ndarray:
    """Return the pixels in view of cameras that do not see a quarter of the turn."""
    visible, middle = SHOWN.copy(), CYLINDER.width // 2
    visible[:, middle - CYLINDER.width // 8 : middle + CYLINDER.width // 8] = False
    return visible


@pytest.mark.parametrize("floor", [plain, worn, stains, worn_with_line])
def test_floor_is_free_up_to_the_wall_whatever_it_shows(floor: Pattern) -> None:
    """A plain floor shows nothing, and no edge at which something could begin; a painted line is a mark."""
    scan = BaseAtRest(floor).scan(pairs=PAIRS)
    assert np.median(scan.free_m) > 0.75 * WALL_M and (scan.free_m < WALL_M + 0.1).all()


@dataclass(frozen=True)
class Case:
    """Something ahead."""

    floor: Pattern
    obstacle: Pole | Bar


@pytest.mark.hazard("H19")
@pytest.mark.parametrize(
    "case",
    [
        Case(plain, Pole(1.6, 0.08)),
        Case(plain, Pole(1.3, 0.06, 90.0)),
        Case(worn, Pole(2.0, 0.08)),
        Case(stains, Pole(1.5, 0.08)),
        Case(plain, Pole(0.45, 0.08)),
        Case(worn, Pole(0.45, 0.08)),
        Case(worn, Pole(0.45, 0.5)),
        Case(plain, Bar(1.4, (0.5, 0.56))),
        Case(stains, Bar(1.4, (0.5, 0.56))),
    ],
)
def test_floor_behind_a_plain_thing_is_not_free(case: Case) -> None:
    """What begins nearer than the floor in view shows no foot, and may stand anywhere before what it hides."""
    scan = BaseAtRest(case.floor).scan(case.obstacle, pairs=PAIRS)
    assert scan.free_m[AHEAD].max() < max(case.obstacle.range_m, 0.3) + 0.15
    if isinstance(case.obstacle, Pole):
        assert np.median(scan.free_m[BEHIND]) > 0.75 * WALL_M


@pytest.mark.parametrize("floor", [plain, worn])
def test_a_joint_that_one_view_shows_displaced_is_floor(floor: Pattern) -> None:
    """Pixels and coding move a joint of 2 cm by a row in one view."""
    base = BaseAtRest(floor)
    for seq in range(PAIRS):
        (lower, _), (_, upper) = (
            panoramas(partial(jointed, floor, at_m), WALL_M, striped, seed=seq) for at_m in (1.4, 1.38)
        )
        scan = base.scans.add(seq * PERIOD_NS, np.eye(4), lower, upper, None)
    assert scan is not None and np.quantile(scan.free_m, 0.02) > 0.75 * WALL_M


@pytest.mark.parametrize("lateral_m", [0.4, 0.5])
def test_a_base_may_begin_between_walls_nearer_than_the_floor_in_view(lateral_m: float) -> None:
    """What hides the nearest floor there goes on as a wall in view; it may stand anywhere only where it does not."""
    free_m = BaseAtRest(worn).scan(Walls(lateral_m), pairs=PAIRS).free_m
    assert free_m[AHEAD].min() > 2.0 and free_m[BEHIND & (np.abs(azimuths()) > math.radians(178))].min() > 2.0
    sideways = np.abs(np.abs(azimuths()) - math.radians(60)) < math.radians(10)
    to_wall_m = lateral_m / np.sin(np.abs(azimuths()[sideways]))
    assert (np.abs(free_m[sideways] - to_wall_m) < 3 * CELL_M).mean() > 0.9


@pytest.mark.parametrize("floor", [plain, worn, stains])
def test_a_hanging_bar_is_where_it_is_seen(floor: Pattern) -> None:
    """Cells around it, to which its evidence belongs as well, stay free."""
    scan = BaseAtRest(floor).scan(Bar(1.4, (0.5, 0.56)), pairs=20)
    assert scan.grid is not None
    cells = np.argwhere(scan.grid.states == OCCUPIED)[:, ::-1] + 0.5
    ranges_m = np.linalg.norm(scan.grid.corner_m + CELL_M * cells, axis=1)
    away_m = np.abs(ranges_m[ranges_m < 2.2] - 1.4)
    assert len(away_m) > 200 and np.quantile(away_m, 0.95) < 0.125


@pytest.mark.hazard("H19")
@pytest.mark.parametrize("floor", [worn, stains])
def test_something_low_begins_at_its_front(floor: Pattern) -> None:
    """Over its top, which shows nothing, the floor behind is seen: its end alone is a surface."""
    scan = BaseAtRest(floor).scan(Block(1.4, 0.4, 0.1), pairs=PAIRS)
    ways = scan.free_m.reshape(-1, 10).min(axis=1)  # of 24 cm at that range
    assert np.median(scan.free_m) > 1.2 and ways.max() < 1.4 + 3 * CELL_M


@pytest.mark.hazard("H19")
def test_a_surface_nearer_than_the_floor_in_view_ends_the_way() -> None:
    """Its top, which looks like the floor, hides the nearest floor in view, and ends beyond."""
    scan = BaseAtRest(stains).scan(Block(0.7, 0.4, 0.5, pattern=stains), pairs=PAIRS)
    assert scan.free_m.max() < 0.85


@pytest.mark.hazard("H19")
def test_floor_behind_a_white_wall_is_not_free() -> None:
    """It shows nothing itself but its foot."""
    wall = lambda azimuth, height_m: np.full(np.shape(azimuth), 200.0)  # noqa: E731
    scan = BaseAtRest(worn).scan(pairs=PAIRS, wall_m=1.8, wall=wall)
    assert np.median(scan.free_m) > 1.2 and scan.free_m.max() < 1.9


@pytest.mark.hazard("H19")
@pytest.mark.parametrize("floor", [plain, worn])
def test_floor_is_not_free_while_a_pole_that_was_put_there_hides_it(floor: Pattern) -> None:
    """It is known in 1.5 s, also by a base at rest, and a second after it has gone the floor is free again."""
    base = BaseAtRest(floor)
    base.scan(pairs=8)
    assert base.scan(Pole(1.5, 0.08), pairs=15).free_m[AHEAD].min() < 1.65
    assert np.median(base.scan(pairs=12).free_m[AHEAD]) > 0.75 * WALL_M


def approached(base: BaseAtRest, obstacle: Callable[[float], Obstacle], to_m: float) -> float:
    """Drive a base towards an obstacle ahead, given by its range; return how far it has come."""
    at_m = 0.0
    for range_m in np.arange(1.6, to_m, -0.03):
        at_m = 1.6 - range_m
        base.scan(obstacle(range_m), wall_m=4.0 - at_m, at_m=at_m)
    return at_m


@pytest.mark.parametrize("floor", [worn, stains])
def test_a_way_is_free_when_a_person_nearer_than_the_floor_in_view_has_left(floor: Pattern) -> None:
    base = BaseAtRest(floor)
    at_m = approached(base, lambda range_m: Pole(range_m, 0.4, 60.0), 0.55)
    assert base.scan(Pole(1.6 - at_m, 0.4, 60.0), pairs=20, at_m=at_m).free_m[AHEAD].max() < 0.7
    assert base.scan(pairs=40, at_m=at_m).free_m[AHEAD].min() > 1.5


@pytest.mark.hazard("H19")
@pytest.mark.parametrize("floor", [worn, stains])
def test_something_low_stays_where_it_is_too_near_to_be_seen(floor: Pattern) -> None:
    """It hides the nearest floor in view on the way, but no longer when the base is near: it has not left."""
    base = BaseAtRest(floor)
    at_m = approached(base, lambda range_m: Block(range_m, 0.3, 0.3, pattern=stains), 0.25)
    scan = base.scan(Block(1.6 - at_m, 0.3, 0.3, pattern=stains), pairs=40, at_m=at_m)
    assert scan.free_m[AHEAD].max() < 0.35


@pytest.mark.hazard("H17")
@pytest.mark.parametrize("floor", [plain, worn, stains])
@pytest.mark.parametrize("ahead_m", [0.0, 0.3])
def test_a_person_who_steps_onto_free_floor_is_found_in_two_pairs(floor: Pattern, ahead_m: float) -> None:
    """As wide as a person, and where the cameras see it; nothing else has come."""
    base = BaseAtRest(floor, ahead_m=ahead_m)
    assert np.isnan(base.scan(pairs=8).arrivals.ranges_m).all()
    found = [base.scan(Pole(1.5, 0.4, 60.0)).arrivals.ranges_m for _ in range(2)]
    came = np.isfinite(found).any(axis=0)
    assert came[AHEAD].all() and not came[np.abs(azimuths()) > math.radians(15)].any()
    assert np.nanmin(found) > 1.3 and np.nanmax(found) < 1.65
    assert base.scan(Pole(1.5, 0.4, 60.0)).free_m[AHEAD].max() < 1.65 + ahead_m


@pytest.mark.hazard("H17")
def test_an_obstacle_that_hides_the_nearest_floor_in_view_may_be_nearer() -> None:
    base = BaseAtRest(stains)
    base.scan(pairs=8)
    scan = base.scan(Pole(0.5, 0.4, 60.0))
    assert scan.arrivals.is_nearer[AHEAD].all() and scan.free_m[AHEAD].max() < 0.7


@pytest.mark.hazard("H19")
def test_nothing_is_free_a_while_after_all_images_are_lost() -> None:
    """Somebody may have come from where nothing was known, at 1.6 m/s: here from a quarter that no camera sees."""
    base = BaseAtRest(stains, without_a_quarter())
    assert np.median(base.scan(pairs=PAIRS).free_m) > 0.75 * WALL_M
    assert base.scan(pairs=25, lost=SHOWN).free_m.max() < 0.5
    assert np.median(base.scan(pairs=PAIRS).free_m) > 0.6 * WALL_M


@pytest.mark.parametrize("degrees", [3.0, 6.0, 9.0])
def test_a_ramp_is_free(degrees: float) -> None:
    """It is a second plane of the floor, from where it begins on."""
    scan = BaseAtRest(stains).scan(Slope(1.4, degrees), pairs=3 * PAIRS)
    assert np.median(scan.free_m[AHEAD]) > 2.2
    assert np.median(scan.free_m[BEHIND]) > 0.75 * WALL_M and scan.free_m.max() < WALL_M + 0.1


@pytest.mark.hazard("H19")
@pytest.mark.parametrize("degrees", [14.0, 20.0])
def test_a_slope_that_is_too_steep_is_not_free(degrees: float) -> None:
    assert BaseAtRest(stains).scan(Slope(1.4, degrees), pairs=3 * PAIRS).free_m[AHEAD].max() < 1.8


@pytest.mark.parametrize("drop_m", [0.12, -0.12])
def test_floor_at_another_height_is_not_free(drop_m: float) -> None:
    """The base states a floor that the images show lower or higher, all around: it ends where it is in view."""
    assert np.median(BaseAtRest(stains).scan(pairs=PAIRS, drop_m=drop_m).free_m) < 0.95


@pytest.mark.parametrize("is_lost", [False, True])
def test_what_is_not_in_view_is_not_free(is_lost: bool) -> None:
    """A quarter of the turn is masked, or its tiles are dead."""
    visible = without_a_quarter()
    base = BaseAtRest(plain) if is_lost else BaseAtRest(plain, visible)
    scan = base.scan(pairs=PAIRS, lost=~visible if is_lost else None)
    assert scan.free_m[np.abs(azimuths()) < math.radians(35)].max() < 0.4


def test_without_floor_in_view_nothing_is_free() -> None:
    """All rows below the horizon are masked."""
    visible = SHOWN.copy()
    visible[round(CYLINDER.row0) + 5 :] = False
    scans = BaseAtRest(plain, visible).scans
    assert scans.add(0, np.eye(4), *panoramas(plain, WALL_M, striped), None) is None
