"""The obstacle grid: rings of drawn rooms, what is remembered too near to be seen, and how it ends in the dark."""

from __future__ import annotations

import math
from functools import cache

import numpy as np
import pytest

from calib import se3
from omnid.core.mapping.range_scan import SECTORS, azimuths
from omnid.core.obstacles.cell_kernels import ABOVE, FLOOR, FREE_ODDS, LEAST_VISIBLE, SURFACE
from omnid.core.obstacles.cell_kernels import VISIBLE as VISIBLE_LAYER
from omnid.core.obstacles.column import NEAREST_M, ColumnEvidence, Columns, floor_plane
from omnid.core.obstacles.grid import CELL_M, CELLS, PRIOR, GridRing, ObstacleGrid
from omnid.core.obstacles.moving_tracker import MovingTracker
from omnid.core.obstacles.near_field import lose_before
from omnid.core.obstacles.pair_views import DIRECTIONS
from omnid.core.obstacles.settings import RingSettings
from omnid.core.obstacles.usual_floor import FLOOD_MPS, FRESH_NS, NEVER, ONCE_FREE_NS
from omnid.core.types.panorama import PaddedPanorama
from tests.omnid.core.obstacles.drawn_floor import (
    BASELINE_M,
    CYLINDER,
    HEIGHT_M,
    T_RECT_BASE,
    Pattern,
    Pole,
    panoramas,
    plain,
    stains,
    striped,
)

WALL_M = 2.0
PERIOD_NS = 100_000_000
VISIBLE = np.zeros((CYLINDER.height, CYLINDER.width), bool)
VISIBLE[8:-8] = True
SETTINGS = RingSettings(max_range_m=4.0)
COLUMNS = Columns(CYLINDER, BASELINE_M, floor_plane(T_RECT_BASE), SETTINGS.heights_m, (NEAREST_M, 6.0), VISIBLE)
AHEAD = slice(SECTORS // 2 - 2, SECTORS // 2 + 2)


SEEDS = range(5)  # of the noise: pairs from one place differ by it
Pairs = list[ColumnEvidence]


@cache  # many tests see the same room
def evidence(
    floor: Pattern, wall: Pattern, drop_m: float = 0.0, wall_m: float = WALL_M, pole: Pole | None = None
) -> Pairs:
    return [COLUMNS.evidence(*panoramas(floor, wall_m, wall, drop_m, pole, seed)) for seed in SEEDS]


@pytest.fixture(scope="module")
def seen() -> Pairs:
    return evidence(stains, striped)


@pytest.fixture
def grid() -> ObstacleGrid:
    made = ObstacleGrid(COLUMNS.at_1m, SETTINGS)
    made.set_floor(T_RECT_BASE, HEIGHT_M)
    return made


def corner_m(grid: ObstacleGrid) -> np.ndarray:
    """Return the place (2,) of the corner of cell (0, 0) in odom."""
    assert grid._corner is not None
    return CELL_M * grid._corner


def after(grid: ObstacleGrid, found: Pairs, pairs: int, first: int = 0) -> GridRing:
    """Return the ring after so many pairs of a base that stands."""
    for n in range(first, first + pairs):
        ring = grid.update(n * PERIOD_NS, np.eye(4), found[n % len(found)])
    return ring


def test_ring_has_the_wall_and_the_floor_before_it(grid: ObstacleGrid, seen: Pairs) -> None:
    ring = after(grid, seen, 40)
    assert np.isfinite(ring.ranges_m).mean() > 0.9
    assert np.nanmedian(ring.ranges_m) == pytest.approx(WALL_M, abs=0.12)
    assert np.median(ring.free_m) > WALL_M - 0.5 and (ring.free_m <= WALL_M + 0.1).all()


def test_free_floor_ends_where_a_low_step_would_look_like_it(grid: ObstacleGrid) -> None:
    """A fall of 5 cm differs from the floor by less than half a row from some 3 m on."""
    ring = after(grid, evidence(stains, striped, wall_m=6.0), 40)
    assert 1.5 < np.median(ring.free_m) < 3.5 and np.isposinf(ring.ranges_m).mean() < 0.1


def test_an_edge_is_not_forgotten_where_the_floor_beyond_it_fits_by_another_period(
    grid: ObstacleGrid, seen: Pairs
) -> None:
    """Many pairs show floor that is much lower; in six, before it is too near to be seen, it looks like the floor."""
    against = [np.where(found.level[1] != 0, np.float32(-10.0), np.float32(0.0)) for found in seen]
    edge = [found._replace(level=np.stack([found.level[0], low])) for found, low in zip(seen, against, strict=True)]
    near_m = COLUMNS.nearest_floor_m
    assert after(grid, edge, 20).free_m.max() < near_m
    assert after(grid, seen, 6, first=20).free_m.max() < near_m
    assert np.median(after(grid, seen, 20, first=26).free_m) > WALL_M - 0.5, "it was none"


@pytest.mark.hazard("H19")
def test_plain_wall_is_unknown_and_nothing_behind_it_is_free(grid: ObstacleGrid) -> None:
    near_m = 1.3
    ring = after(grid, evidence(stains, plain, wall_m=near_m), 40)
    assert np.isnan(ring.ranges_m).mean() > 0.9
    assert ring.free_m.max() <= near_m + 0.2 and np.median(ring.free_m) > near_m - 0.35


@pytest.mark.hazard("H19")
@pytest.mark.parametrize("grey", [120.0, 190.0])
def test_floor_behind_a_thin_plain_pole_is_not_free(grid: ObstacleGrid, grey: float) -> None:
    """A column of a plain pole shows nothing; the floor that it hides is missing, one degree wide or two."""
    ring = after(grid, evidence(stains, striped, wall_m=3.0, pole=Pole(1.3, 0.05, grey)), 30)
    assert ring.free_m[AHEAD].min() < 1.8
    beside = np.r_[SECTORS // 2 - 12 : SECTORS // 2 - 6, SECTORS // 2 + 6 : SECTORS // 2 + 12]
    assert ring.free_m[beside].min() > 2.0


@pytest.mark.hazard("H19")
@pytest.mark.parametrize("grey", [120.0, 190.0])
def test_floor_that_was_free_is_not_while_a_thin_plain_pole_hides_it(grid: ObstacleGrid, grey: float) -> None:
    """As the base drives around a pole it hides floor that was seen from elsewhere, and shows what it hid."""
    bare, hidden = (evidence(stains, striped, wall_m=3.0, pole=pole) for pole in (None, Pole(1.3, 0.05, grey)))
    assert after(grid, bare, 30).free_m[AHEAD].min() > 2.0
    assert after(grid, hidden, 9, first=30).free_m[AHEAD].min() < 1.8
    assert after(grid, bare, 8, first=39).free_m[AHEAD].min() > 2.0


@pytest.mark.hazard("H19")
def test_nothing_is_free_before_hidden_floor_that_is_the_nearest_in_view(grid: ObstacleGrid) -> None:
    """A thin plain pole is nearer than all floor in view: it may be anywhere before what it hides."""
    near_m = 0.5 * COLUMNS.nearest_floor_m
    bare, hidden = (evidence(stains, striped, wall_m=3.0, pole=pole) for pole in (None, Pole(near_m, 0.05)))
    after(grid, bare, 30)
    ring = after(grid, hidden, 8, first=30)
    assert np.median(ring.free_m[AHEAD]) < 0.2 and np.median(ring.free_m) > 2.0
    assert after(grid, bare, 8, first=38).free_m[AHEAD].min() > 2.0


def test_a_place_that_was_hidden_for_long_is_free_again(grid: ObstacleGrid) -> None:
    """A pole stood too near to be seen for longer than floor counts as free lately, and has left."""
    near_m = 0.5 * COLUMNS.nearest_floor_m
    bare, hidden = (evidence(stains, striped, wall_m=3.0, pole=pole) for pole in (None, Pole(near_m, 0.05)))
    after(grid, bare, 30)
    stood = round(1.2 * ONCE_FREE_NS / PERIOD_NS)
    assert np.median(after(grid, hidden, stood, first=30).free_m[AHEAD]) < 0.2
    assert after(grid, bare, 20, first=30 + stood).free_m[AHEAD].min() > 2.0


def test_floor_before_a_surface_that_hides_the_nearest_in_view_stays_free(grid: ObstacleGrid) -> None:
    """People come to 0.7 m from all sides: they are seen, and explain why no floor is."""
    bare, people = evidence(stains, striped, wall_m=3.0), evidence(stains, striped, wall_m=0.7)
    after(grid, bare, 30)
    after(grid, people, 6, first=30)
    column, row = np.floor((np.array([0.35, 0.0]) - corner_m(grid)) / CELL_M).astype(int)
    assert grid._odds[VISIBLE_LAYER][row, column] == PRIOR[VISIBLE_LAYER] and grid.state()[row, column] == 1


def test_directions_cross_where_a_thin_thing_stands_that_is_too_near_to_be_seen(grid: ObstacleGrid) -> None:
    """A pole of 4 cm, 0.6 m ahead and 0.25 m to the left, hides other floor as the base drives."""
    middle, nearest, pole = np.full(2, CELLS / 2), round(1.0 / CELL_M), np.array([0.6, 0.25]) / CELL_M
    centres = np.stack(np.meshgrid(np.arange(CELLS), np.arange(CELLS)), axis=-1) + 0.5 - middle
    visible = np.full((CELLS, CELLS), PRIOR[VISIBLE_LAYER])
    for x_m in np.arange(0.0, 0.55, 0.05):
        base = np.array([x_m / CELL_M, 0.0])
        away, to_pole = centres - base, pole - base
        across = np.abs(away[..., 0] * to_pole[1] - away[..., 1] * to_pole[0]) / np.linalg.norm(to_pole)
        half_rad = 0.02 / CELL_M / np.linalg.norm(to_pole)
        lost = np.where((across / np.linalg.norm(away, axis=-1) < half_rad) & ((away @ to_pole) > 0), 1.0, -1.0)
        near = np.where(np.abs(azimuths() - math.atan2(to_pole[1], to_pole[0])) < half_rad, 1.0, -1.0)
        lost, near = lost.astype(np.float32), near.astype(np.float32)
        lose_before(lost, near, middle + base, azimuths(), nearest)
        visible = np.clip(visible - lost, LEAST_VISIBLE, PRIOR[VISIBLE_LAYER])
    hidden = visible <= 0.0
    column, row = np.floor(middle + pole).astype(int)
    assert hidden[row, column]
    # Beside it, and where it was looked past before, floor is free again.
    assert not hidden[row, column + 4] and not hidden[row - 3, column - 3] and not hidden[row + 6, column + 12]


@pytest.mark.parametrize("drop_m", [0.3, 0.08, -0.08])
def test_floor_at_another_height_is_unknown(grid: ObstacleGrid, drop_m: float) -> None:
    ring = after(grid, evidence(stains, striped, drop_m), 40)
    assert ring.free_m.max() < 1.3 and not np.isposinf(ring.ranges_m).any()


def test_no_floor_behind_a_near_wall_is_taken_to_be_free_at_the_start(grid: ObstacleGrid) -> None:
    """The nearest floor in view would be behind it."""
    near_m = 0.65
    ring = after(grid, evidence(stains, striped, wall_m=near_m), 1)
    assert np.quantile(ring.free_m, 0.9) < near_m + 0.05


def test_start_at_a_heading_that_is_zero_but_for_rounding(grid: ObstacleGrid, seen: Pairs) -> None:
    """A turn modulo 1 is 1, not 0, just below 0."""
    pose = np.eye(4)
    pose[1, 0] = -1e-17
    assert grid.update(0, pose, seen[0]).free_m.min() > 0


def test_floor_beside_a_step_is_not_free(grid: ObstacleGrid) -> None:
    """Directions are compared together, so those at a corner show half the floor beside it."""
    grid._odds[:SURFACE] = 4.0
    grid._odds[ABOVE, 98:103, 98:103] = -3.0
    free = grid.state() == 1
    assert not free[97:104, 99:102].any() and not free[99:102, 97:104].any()
    assert free[96, 100] and free[100, 104]


@pytest.mark.hazard("H19")
def test_without_fresh_evidence_the_floor_around_ends(grid: ObstacleGrid, seen: Pairs) -> None:
    assert after(grid, seen, 20).free_m.min() > 0.6
    dark = seen[0]._replace(
        surface=np.zeros_like(seen[0].surface), floor=0 * seen[0].floor, level=np.zeros_like(seen[0].level)
    )
    seconds = 3 * FRESH_NS * 1e-9 + seen[0].nearest_floor_m / FLOOD_MPS
    ring = after(grid, [dark], int(seconds * 1e9 / PERIOD_NS) + 1, first=20)
    assert ring.free_m.max() < 0.45


def test_weak_evidence_of_one_place_is_no_surface_however_long_the_base_stands(grid: ObstacleGrid, seen: Pairs) -> None:
    """Errors of pairs from one place are the same: 20 s of them are no obstacle, and hide none that comes."""
    weak, strong = (
        seen[0]._replace(
            surface=np.full_like(seen[0].surface, log_odds), floor=0 * seen[0].floor, level=0 * seen[0].level
        )
        for log_odds in (0.4, 0.8)
    )
    assert not np.isfinite(after(grid, [weak], 200).ranges_m).any()
    assert np.isfinite(after(grid, [strong], 30, first=200).ranges_m).mean() > 0.9


@pytest.mark.parametrize(("log_odds", "is_found"), [(0.14, False), (0.5, True)])
def test_noise_is_no_surface_however_far_the_base_drives(
    grid: ObstacleGrid, seen: Pairs, log_odds: float, is_found: bool
) -> None:
    pair = seen[0]._replace(
        surface=np.full_like(seen[0].surface, log_odds), floor=0 * seen[0].floor, level=0 * seen[0].level
    )
    pose = np.eye(4)
    for n in range(100):
        pose[0, 3] = n * CELL_M
        ring = grid.update(n * PERIOD_NS, pose, pair)
    assert np.isfinite(ring.ranges_m).any() == is_found


@pytest.mark.hazard("H19")
def test_what_every_second_pair_shows_is_not_free(grid: ObstacleGrid, seen: Pairs) -> None:
    """As a bar under which the floor is seen: the pairs between them contradict it, so that it is never taken."""
    shown = seen[0].surface.copy()
    near = round(COLUMNS.at_1m / 1.3)
    shown[near - 1 : near + 2, DIRECTIONS // 2 - 3 : DIRECTIONS // 2 + 3] = 1.5
    ring = after(grid, [seen[0], seen[1]._replace(surface=shown)], 60)
    assert 1.0 < ring.free_m[AHEAD].min() < 1.35
    assert ring.free_m[SECTORS // 2 + 10 : SECTORS // 2 + 30].min() > 1.5


@pytest.mark.parametrize(("gap_cells", "comes_in"), [(2, False), (6, True)])
def test_nothing_comes_in_through_a_narrow_gap(grid: ObstacleGrid, seen: Pairs, gap_cells: int, comes_in: bool) -> None:
    """A ring about the base that was never free, with a gap; in the dark something may have come to all other floor."""
    after(grid, seen, 20)
    middle = np.floor(-corner_m(grid) / CELL_M).astype(int)
    y, x = np.ogrid[: grid._odds.shape[1], : grid._odds.shape[2]]
    x, y = x - middle[0], y - middle[1]
    away = np.hypot(x, y)
    ring = (away > 8) & (away < 12) & ~((x > 0) & (y >= 0) & (y < gap_cells))
    grid._odds[FLOOR][ring], grid._watch.free_ns[ring] = PRIOR[FLOOR], NEVER
    dark = seen[0]._replace(
        surface=np.zeros_like(seen[0].surface), floor=0 * seen[0].floor, level=np.zeros_like(seen[0].level)
    )
    after(grid, [dark], 40, first=20)
    is_free = grid._odds[FLOOR][(away > 5) & (away < 7)] > FREE_ODDS
    assert is_free.any() != comes_in and is_free.all() != comes_in


@pytest.mark.hazard("H19")
@pytest.mark.parametrize(("range_m", "free_m"), [(1.3, 1.35), (0.8, 0.4)])
def test_what_comes_into_view_ends_the_free_floor_until_it_goes(
    grid: ObstacleGrid, seen: Pairs, range_m: float, free_m: float
) -> None:
    """A plain column 0.4 m wide, where floor was. What hides the nearest floor in view may stand nearer as well."""
    assert after(grid, seen, 20).free_m[AHEAD].min() > 1.4
    person = evidence(stains, striped, pole=Pole(range_m, 0.4))
    ring = after(grid, person, 25, first=20)
    assert ring.free_m[AHEAD].max() < free_m and np.median(ring.free_m) > 1.4
    # It has gone: the floor is seen past all places at which it may stand.
    assert after(grid, seen, 25, first=45).free_m[AHEAD].min() > 1.4


def test_floor_is_kept_too_near_to_be_seen_as_long_as_the_way_to_it_is_watched(grid: ObstacleGrid, seen: Pairs) -> None:
    assert after(grid, seen, 60).free_m.min() > seen[0].nearest_floor_m - 0.2


@pytest.mark.parametrize(("wall", "is_known"), [(striped, True), (plain, False)])
def test_floor_before_a_wall_too_near_for_floor_is_kept_where_the_wall_is_seen(
    grid: ObstacleGrid, wall: Pattern, is_known: bool
) -> None:
    """As beside the walls of a corridor: a person who came between would hide the wall; a plain one shows nothing."""
    near_m = 0.75
    found = evidence(stains, wall, wall_m=near_m)
    assert found[0].nearest_floor_m > near_m
    after(grid, found, 20)
    grid._watch.flooded[:] = 1  # something may have come from all sides
    grid._odds[FLOOR] = PRIOR[FLOOR]
    ring = after(grid, found, 3, first=20)
    assert (np.median(ring.free_m) > near_m - 0.25) == is_known


def test_nothing_is_known_after_clear(grid: ObstacleGrid, seen: Pairs) -> None:
    after(grid, seen, 20)
    grid.clear()
    assert not grid.state().any()


def test_square_follows_the_base(grid: ObstacleGrid, seen: Pairs) -> None:
    after(grid, seen, 20)
    far = np.eye(4)
    far[0, 3] = 50.0
    ring = grid.update(20 * PERIOD_NS, far, seen[0])
    assert np.abs(corner_m(grid) - [50.0 - 6.4, -6.4]).max() < 0.1 and not np.isfinite(ring.ranges_m).any()


def test_patch_of_usual_floor_that_shows_none_stays_free_where_floor_behind_it_is_seen(
    grid: ObstacleGrid, seen: Pairs
) -> None:
    """A polished floor shows what it mirrors in the place of its own texture; who stands there hides more."""
    after(grid, seen, 20)
    for n in range(20, 30):
        dull = seen[n % len(seen)].floor.copy()
        bins = slice(int(COLUMNS.at_1m / 1.5), int(COLUMNS.at_1m / 1.2))
        dull[bins, DIRECTIONS // 2 - 6 : DIRECTIONS // 2 + 6] = -2.0
        ring = grid.update(n * PERIOD_NS, np.eye(4), seen[n % len(seen)]._replace(floor=dull))
    assert ring.free_m[AHEAD].min() > 1.5


@pytest.mark.hazard("H17")
@pytest.mark.parametrize("grey", [120.0, 190.0])
def test_who_steps_onto_free_floor_is_found_in_the_first_pair(grid: ObstacleGrid, seen: Pairs, grey: float) -> None:
    """Somebody plain, 30 cm wide; the room that stands, and who has stood there from the start, have not come."""
    person = evidence(stains, striped, pole=Pole(1.3, 0.3, grey))
    assert np.isnan(after(grid, seen, 20).arrivals.ranges_m).all()
    came = grid.update(20 * PERIOD_NS, np.eye(4), person[0])
    assert np.nanmedian(came.arrivals.ranges_m[AHEAD]) == pytest.approx(1.3, abs=0.15)
    found = np.isfinite(came.arrivals.ranges_m)
    assert 0.3 * np.degrees(0.3 / 1.3) < found.sum() < 2 * np.degrees(0.3 / 1.3)
    assert (came.arrivals.sigma_m[found] < 0.1).all()
    stays = [after(grid, person, 1, first=n).arrivals.ranges_m[AHEAD] for n in range(21, 31)]
    seen_m = [np.nanmedian(ranges_m) for ranges_m in stays if np.isfinite(ranges_m).any()]
    assert len(seen_m) >= 8 and np.allclose(seen_m, 1.3, atol=0.15)
    assert np.isnan(after(grid, seen, 5, first=31).arrivals.ranges_m).all(), "the floor is as it was"
    grid.clear()
    assert np.isnan(after(grid, person, 20).arrivals.ranges_m).all()


@pytest.mark.hazard("H17")
def test_who_comes_is_where_the_cameras_see_them_wherever_they_are_on_the_base(grid: ObstacleGrid, seen: Pairs) -> None:
    """The cameras are 0.4 m ahead of the base's origin and 0.3 m to the right; the base has turned by 50 degrees."""
    T_base_eye, T_odom_base = np.eye(4), np.eye(4)
    T_base_eye[:2, 3] = 0.4, -0.3
    T_odom_base[:3, :3] = se3.rotation_exp([0.0, 0.0, np.deg2rad(50.0)])
    grid.set_floor(T_RECT_BASE @ se3.inverse(T_base_eye), HEIGHT_M)
    person, tracker = evidence(stains, striped, pole=Pole(1.3, 0.3)), MovingTracker()
    for n in range(20):
        grid.update(n * PERIOD_NS, T_odom_base, seen[n % len(seen)])
    for n in range(20, 23):
        ring = grid.update(n * PERIOD_NS, T_odom_base, person[n % len(person)])
        moving = tracker.update(n * PERIOD_NS, grid.viewpoint(T_odom_base), ring.arrivals)
    (found,) = moving
    truth = T_odom_base @ T_base_eye @ np.array([1.3, 0.0, 0.0, 1.0])
    assert (found.x_m, found.y_m) == pytest.approx(tuple(truth[:2]), abs=0.1)


def test_what_is_too_near_to_be_seen_lies_about_the_viewpoint(grid: ObstacleGrid) -> None:
    """The cameras are 0.42 m to the left of the origin; a thin plain pole comes nearer than all floor in view."""
    T_base_eye, near_m = np.eye(4), 0.5 * COLUMNS.nearest_floor_m
    left_m = T_base_eye[1, 3] = 0.42  # within a cell, not between two
    grid.set_floor(T_RECT_BASE @ se3.inverse(T_base_eye), HEIGHT_M)
    bare, hidden = (evidence(stains, striped, wall_m=3.0, pole=pole) for pole in (None, Pole(near_m, 0.05)))

    def is_free(x_m: float, y_m: float) -> bool:
        column, row = np.floor((np.array([x_m, y_m]) - corner_m(grid)) / CELL_M).astype(int)
        return bool(grid.state()[row, column] == 1)

    after(grid, bare, 1)
    assert is_free(0.0, left_m + 1.8 * near_m), "too near to be seen at the start, and farther from the origin"
    after(grid, bare, 30)
    after(grid, hidden, 8, first=30)
    assert not is_free(0.8 * near_m, left_m) and is_free(0.8 * near_m, 0.0)


def test_who_has_left_a_place_too_near_to_see_its_floor_is_no_obstacle_any_longer(
    grid: ObstacleGrid, seen: Pairs
) -> None:
    """All around stand people at 0.7 m, where surfaces are in view and the floor is not; then they leave."""
    assert COLUMNS.nearest_floor_m > 0.9
    after(grid, seen, 20)
    ring = after(grid, evidence(stains, striped, wall_m=0.7), 30, first=20)
    assert np.isfinite(ring.ranges_m).mean() > 0.95 and np.nanmax(ring.ranges_m) < 0.9
    ring = after(grid, seen, 80, first=50)
    assert np.nanmin(ring.ranges_m) > 1.5 and np.median(ring.free_m) > WALL_M - 0.5


def put_low_box(grid: ObstacleGrid, ahead_m: float = 0.65) -> None:
    """Make the grid know a low box, as from farther away."""
    middle, ahead = np.round(-corner_m(grid) / CELL_M).astype(int), round(ahead_m / CELL_M)
    grid._odds[SURFACE, middle[1] - 4 : middle[1] + 4, middle[0] + ahead : middle[0] + ahead + 2] = 6.0


@pytest.mark.parametrize("people_before", [False, True])
def test_a_low_thing_that_was_seen_from_farther_away_stays_where_nothing_shows_it(
    grid: ObstacleGrid, seen: Pairs, people_before: bool
) -> None:
    after(grid, seen, 20)
    if people_before:
        after(grid, evidence(stains, striped, wall_m=0.7), 30, first=20)
        after(grid, seen, 150, first=50)
    put_low_box(grid)
    assert after(grid, seen, 100, first=200).ranges_m[AHEAD].max() < 0.75


def test_who_stood_near_when_odometry_began_again_and_leaves_is_no_obstacle(grid: ObstacleGrid, seen: Pairs) -> None:
    after(grid, seen, 20)
    after(grid, evidence(stains, striped, wall_m=0.7), 30, first=20)
    grid.begin_again()
    assert np.nanmin(after(grid, seen, 150, first=50).ranges_m) > 1.5


@pytest.fixture(scope="module")
def turning() -> list[tuple[float, tuple[PaddedPanorama, PaddedPanorama]]]:
    """Return the yaw [rad] and the panoramas of a base that stands, and then turns on the spot."""
    made = [(0.0, panoramas(stains, 3.0, striped, seed=n)) for n in range(15)]
    for n in range(15, 30):
        yaw = 0.08 * (n - 14)
        c, s = np.cos(yaw), np.sin(yaw)
        views = panoramas(
            lambda x, y, c=c, s=s: stains(c * x - s * y, s * x + c * y),  # type: ignore[misc]
            3.0,
            lambda azimuth, height, yaw=yaw: striped(azimuth + yaw, height),  # type: ignore[misc]
            seed=n,
        )
        made.append((yaw, views))
    return made


@pytest.mark.parametrize("strut_deg", [4.0, 8.0])
def test_masked_struts_of_a_base_that_turns_are_no_person_who_comes(
    grid: ObstacleGrid, turning: list[tuple[float, tuple[PaddedPanorama, PaddedPanorama]]], strut_deg: float
) -> None:
    visible = VISIBLE.copy()
    azimuths_deg = np.degrees(np.pi - (np.arange(CYLINDER.width) + 0.5) / CYLINDER.focal_px)
    for strut in (40.0, 160.0, -80.0):
        visible[:, np.abs((azimuths_deg - strut + 180) % 360 - 180) < strut_deg / 2] = False
    columns = Columns(CYLINDER, BASELINE_M, floor_plane(T_RECT_BASE), SETTINGS.heights_m, (NEAREST_M, 6.0), visible)
    tracker, found, moving = MovingTracker(), 0, 0
    for n, (yaw, views) in enumerate(turning):
        pose = se3.transform(se3.exp(np.array([0, 0, 0, 0, 0, yaw]))[:3, :3], [0.0, 0.0, 0.0])
        ring = grid.update(n * PERIOD_NS, pose, columns.evidence(*views))
        found += int(np.isfinite(ring.arrivals.ranges_m).sum())
        moving += len(tracker.update(n * PERIOD_NS, grid.viewpoint(pose), ring.arrivals))
    assert (found, moving) == (0, 0)
    assert (ring.free_m > 1.0).mean() > 0.95


def test_a_surface_stands_no_farther_than_its_foot_where_the_rig_leans_away(grid: ObstacleGrid) -> None:
    """The rig leans to the front by 8 degrees: what is seen behind at eye level would be 0.13 m farther by its foot."""
    k = round(COLUMNS.at_1m / 1.5)
    nothing = np.full((COLUMNS.bins, DIRECTIONS), np.nan, np.float32)
    surface = np.zeros_like(nothing)
    surface[k] = 5.0
    shown = ColumnEvidence(nothing, surface, np.zeros((2, *surface.shape), np.float32), 0.0, np.ones(DIRECTIONS, bool))
    upright = after(grid, [shown], 30).ranges_m
    leaning = ObstacleGrid(COLUMNS.at_1m, SETTINGS)
    T_base_rect = se3.transform(se3.exp(np.array([0, 0, 0, 0, np.radians(8), 0]))[:3, :3], [0.0, 0.0, HEIGHT_M])
    leaning.set_floor(se3.inverse(T_base_rect), HEIGHT_M)
    ring = after(leaning, [shown], 30)
    behind = np.r_[:10, SECTORS - 10 : SECTORS]
    assert np.median(upright[behind]) == pytest.approx(1.5, abs=0.1)
    assert np.median(ring.ranges_m[behind]) == pytest.approx(np.median(upright[behind]), abs=0.08)
