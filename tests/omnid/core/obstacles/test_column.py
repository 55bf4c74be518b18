"""Evidence of columns: where the wall and the floor are, and that what shows nothing is no evidence."""

from __future__ import annotations

import numpy as np
import pytest

from omnid.core.obstacles.column import NEAREST_M, ColumnEvidence, Columns, floor_plane
from omnid.core.obstacles.evidence_kernels import PART
from omnid.core.obstacles.panoramas import DIRECTIONS
from tests.omnid.core.obstacles.drawn_floor import (
    BASELINE_M,
    CYLINDER,
    HEIGHT_M,
    T_RECT_BASE,
    Pattern,
    courses,
    panoramas,
    plain,
    ribbed,
    stains,
    striped,
    worn,
    worn_with_line,
)

WALL_M = 2.0
VISIBLE = np.zeros((CYLINDER.height, CYLINDER.width), bool)
VISIBLE[8:-8] = True


@pytest.fixture(scope="module")
def columns() -> Columns:
    return Columns(CYLINDER, BASELINE_M, floor_plane(T_RECT_BASE), (0.06, 1.3), (NEAREST_M, 6.0), VISIBLE)


def evidence(columns: Columns, floor: Pattern, wall: Pattern, drop_m: float = 0.0) -> ColumnEvidence:
    return columns.evidence(columns.panoramas.pair(*panoramas(floor, WALL_M, wall, drop_m)))


def floor_at(columns: Columns, found: ColumnEvidence, near_m: float, far_m: float) -> np.ndarray:
    """Return the evidence of the floor between two ranges."""
    return found.floor[int(columns.at_1m / far_m) : int(columns.at_1m / near_m)]


def test_floor_plane_of_an_upright_rig_is_level() -> None:
    assert floor_plane(T_RECT_BASE) == pytest.approx((HEIGHT_M, 0.0, 0.0))


def test_parts_of_directions_are_whole() -> None:
    """The loops over a part do not ask where the directions end."""
    assert DIRECTIONS % PART == 0


def test_wall_and_the_floor_before_it_are_found_in_all_directions(columns: Columns) -> None:
    found = evidence(columns, stains, striped)
    assert (np.abs(np.argmax(found.surface, axis=0) - columns.at_1m / WALL_M) <= 1.5).mean() > 0.95
    assert (floor_at(columns, found, 1.1, 1.6) > 1).mean() > 0.9
    assert (floor_at(columns, found, 2.5, 4.0) < -1).mean() > 0.95
    assert (found.surface[int(columns.at_1m / 1.5) :] > 2).mean() < 0.01


def test_wall_of_courses_that_are_all_alike_is_none_farther_away_below_the_floor(columns: Columns) -> None:
    """By another number of courses it fits farther away, but not near its foot: there the floor would be above it."""
    found = columns.evidence(columns.panoramas.pair(*panoramas(stains, 1.2, courses)))
    at = round(columns.at_1m / 1.2)
    assert (found.surface[at - 2 : at + 3].max(axis=0) > 2).mean() > 0.95
    assert (found.surface[at + 3 :] > 2).mean() < 0.01


def test_floor_of_weak_texture_is_weak_evidence_for_the_floor(columns: Columns) -> None:
    """Stains of 3 grey levels with noise of 1 say less than strong ones, and the right thing."""
    weak, strong = (floor_at(columns, evidence(columns, floor, striped), 1.1, 1.6) for floor in (worn, stains))
    assert 1.0 < weak.mean() < 0.8 * strong.mean() and (weak < -1).mean() < 0.01


def test_directions_together_show_weak_floor_beside_the_base(columns: Columns) -> None:
    """Of single directions one in ten shows no floor nearer than 1.1 m, and the weakest ones of a cell count."""
    found = evidence(columns, worn, striped)
    assert np.percentile(floor_at(columns, found, 1.0, 1.1), 5) > 0.5
    assert np.percentile(floor_at(columns, found, 1.15, 1.6), 5) > 2.0


def test_a_line_painted_on_the_floor_hides_no_weak_texture_around_it(columns: Columns) -> None:
    """Before and behind the line the evidence is that of the floor without it."""
    bare, painted = (evidence(columns, floor, striped) for floor in (worn, worn_with_line))
    for near_m, far_m in ((1.2, 1.4), (1.65, 1.8)):
        without, beside = (floor_at(columns, found, near_m, far_m) for found in (bare, painted))
        assert beside.mean() > 0.75 * without.mean() > 0.75


def test_plain_wall_and_plain_floor_are_no_evidence(columns: Columns) -> None:
    found = evidence(columns, plain, plain)
    inner = floor_at(columns, found, 1.0, 1.6)
    assert abs(inner.mean()) < 0.3 and np.percentile(np.abs(inner), 95) < 3.0
    assert np.percentile(found.surface, 99.5) < 2


def test_floor_that_is_lower_is_no_floor(columns: Columns) -> None:
    level, lower = (floor_at(columns, evidence(columns, stains, striped, drop), 1.1, 1.6) for drop in (0.0, 0.15))
    assert np.median(lower) < -1 and np.median(level) > 1


@pytest.mark.parametrize(("drop_m", "others"), [(0.08, 1), (-0.08, 0)])
def test_low_steps_are_not_the_floor(columns: Columns, drop_m: float, others: int) -> None:
    """8 cm are 0.8 to 1.4 rows of disparity at 1.2 to 1.8 m."""
    near, far = int(columns.at_1m / 1.2), int(columns.at_1m / 1.8)
    level, step = (evidence(columns, stains, striped, drop).level[:, far:near] for drop in (0.0, drop_m))
    assert (level.mean(axis=2) > 1).all() and (step[others].mean(axis=1) < -1).all()


def test_a_floor_that_repeats_itself_and_falls_deep_is_no_floor_where_its_period_fits(columns: Columns) -> None:
    """Ribs of 11 cm that lie 0.5 m lower fit as the floor does 1 to 1.25 m away; 1.3 m and farther they do not."""
    found = evidence(columns, ribbed, striped, 0.5)
    fits = slice(int(columns.at_1m / 1.25), int(columns.at_1m / 1.0))
    farther = slice(int(columns.at_1m / 1.6), int(columns.at_1m / 1.3))
    assert np.nanmean(found.floor[fits]) > 1
    assert found.level[1, fits].mean() < 1.5 and found.level[1, farther].mean() < -10


def test_noise_of_a_plain_floor_shows_no_step(columns: Columns) -> None:
    """The best of thirty planes fits noise better than the floor does."""
    found = evidence(columns, plain, plain)
    seen = slice(int(columns.at_1m / 1.6), int(columns.at_1m / 1.0))
    assert (np.abs(found.level[:, seen].mean(axis=(1, 2))) < 0.6).all()


def test_lost_pixels_are_no_evidence(columns: Columns) -> None:
    lost = np.zeros((CYLINDER.height, CYLINDER.width), bool)
    lost[:, 400:] = True
    found = columns.evidence(columns.panoramas.pair(*panoramas(stains, WALL_M, striped), lost))
    first = int(400 / CYLINDER.width * DIRECTIONS) + 2
    gone = slice(first, DIRECTIONS - 2)
    assert not found.surface[:, gone].any() and not found.level[:, :, first + 3 : DIRECTIONS - 5].any()
    assert np.nanmax(np.abs(found.floor[:, gone])) < 1e-3
    assert found.surface[:, : first - 4].any()


def test_cameras_that_see_no_floor_have_no_evidence_of_it() -> None:
    visible = np.zeros_like(VISIBLE)
    visible[8:90] = True
    columns = Columns(CYLINDER, BASELINE_M, floor_plane(T_RECT_BASE), (0.06, 1.3), (NEAREST_M, 6.0), visible)
    found = columns.evidence(columns.panoramas.pair(*panoramas(stains, WALL_M, striped)))
    assert not found.floor.any()


def test_floor_nearer_than_a_scan_that_no_direction_shows_is_not_used() -> None:
    """People who cross the scan would be out of view on their way to the base."""
    visible = VISIBLE.copy()
    visible[160:175] = False  # 1.4 to 1.7 m away
    whole, cut = (
        Columns(CYLINDER, BASELINE_M, floor_plane(T_RECT_BASE), (0.06, 1.3), (NEAREST_M, 6.0), shown)
        for shown in (VISIBLE, visible)
    )
    # Floor below rows of the horizon that are hidden is seen as before, and so is that beside a speck.
    horizon, speck = VISIBLE.copy(), VISIBLE.copy()
    horizon[78:96] = False
    speck[160:175, 100:400] = False
    others = (
        Columns(CYLINDER, BASELINE_M, floor_plane(T_RECT_BASE), (0.06, 1.3), (NEAREST_M, 6.0), shown)
        for shown in (horizon, speck)
    )
    floors_m = [one.at_1m / np.flatnonzero(_floor_of(one).any(axis=1)).max() for one in (whole, cut, *others)]
    assert floors_m[0] < 1.1 and floors_m[1] > 1.7 and floors_m[2:] == pytest.approx(2 * floors_m[:1])


def _floor_of(columns: Columns) -> np.ndarray:
    """Return the evidence (K, DIRECTIONS) of a floor with stains."""
    return columns.evidence(columns.panoramas.pair(*panoramas(stains, WALL_M, striped))).floor
