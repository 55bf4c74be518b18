"""The obstacle grid: rings of drawn rooms, what is remembered too near to be seen, and how it ends in the dark."""

from __future__ import annotations

import numpy as np
import pytest

from tests.experiments.obstacle_posterior.column import ColumnEvidence, Columns, HeightBand, floor_plane
from tests.experiments.obstacle_posterior.drawn_floor import (
    BASELINE_M,
    CYLINDER,
    HEIGHT_M,
    T_RECT_BASE,
    Pattern,
    panoramas,
    plain,
    stains,
    striped,
)
from tests.experiments.obstacle_posterior.grid import FLOOD_MPS, FRESH_NS, ObstacleGrid

WALL_M = 2.0
PERIOD_NS = 100_000_000
VISIBLE = np.zeros((CYLINDER.height, CYLINDER.width), bool)
VISIBLE[8:-8] = True

pytestmark = pytest.mark.slow  # its functions are compiled first


def evidence(floor: Pattern, wall: Pattern, drop_m: float = 0.0, wall_m: float = WALL_M) -> ColumnEvidence:
    columns = Columns(CYLINDER, BASELINE_M, floor_plane(T_RECT_BASE, 0.0), HeightBand(0.06, 1.3, 0.05), (0.5, 6.0))
    return columns.evidence(*panoramas(floor, wall_m, wall, drop_m), VISIBLE)


@pytest.fixture(scope="module")
def seen() -> ColumnEvidence:
    return evidence(stains, striped)


@pytest.fixture
def grid() -> ObstacleGrid:
    focal = CYLINDER.focal_px
    return ObstacleGrid(T_RECT_BASE, focal * BASELINE_M, focal, HEIGHT_M, 4.0)


def test_ring_has_the_wall_and_the_floor_before_it(grid: ObstacleGrid, seen: ColumnEvidence) -> None:
    for n in range(40):
        ring = grid.update(n * PERIOD_NS, np.eye(4), seen)
    assert np.isfinite(ring.ranges_m).mean() > 0.9
    assert np.nanmedian(ring.ranges_m) == pytest.approx(WALL_M, abs=0.2)
    assert np.median(ring.free_m) > WALL_M - 0.5 and (ring.free_m <= WALL_M + 0.1).all()


def test_plain_wall_is_unknown_and_nothing_behind_it_is_free(grid: ObstacleGrid) -> None:
    near_m = 1.3
    plain_wall = evidence(stains, plain, wall_m=near_m)
    for n in range(40):
        ring = grid.update(n * PERIOD_NS, np.eye(4), plain_wall)
    assert np.isnan(ring.ranges_m).mean() > 0.9
    assert ring.free_m.max() <= near_m + 0.2 and np.median(ring.free_m) > near_m - 0.3


def test_lower_floor_is_an_edge(grid: ObstacleGrid) -> None:
    lower = evidence(stains, striped, 0.3)
    for n in range(40):
        ring = grid.update(n * PERIOD_NS, np.eye(4), lower)
    assert np.isfinite(ring.ranges_m).mean() > 0.9 and np.nanmedian(ring.ranges_m) < 1.3


def test_without_fresh_evidence_the_floor_around_ends(grid: ObstacleGrid, seen: ColumnEvidence) -> None:
    for n in range(20):
        lit = grid.update(n * PERIOD_NS, np.eye(4), seen)
    assert lit.free_m.min() > 0.6
    dark = seen._replace(**{name: np.zeros_like(getattr(seen, name)) for name in ("surface", "floor", "below")})
    seconds = 3 * FRESH_NS * 1e-9 + seen.nearest_floor_m / FLOOD_MPS
    for n in range(20, 20 + int(seconds * 1e9 / PERIOD_NS) + 1):
        ring = grid.update(n * PERIOD_NS, np.eye(4), dark)
    assert ring.free_m.max() < 0.45


def test_floor_is_kept_too_near_to_be_seen_as_long_as_the_way_to_it_is_watched(grid: ObstacleGrid, seen: ColumnEvidence
                                                                             ) -> None:
    for n in range(60):
        ring = grid.update(n * PERIOD_NS, np.eye(4), seen)
    assert ring.free_m.min() > seen.nearest_floor_m - 0.2


def test_nothing_is_known_after_clear(grid: ObstacleGrid, seen: ColumnEvidence) -> None:
    for n in range(20):
        grid.update(n * PERIOD_NS, np.eye(4), seen)
    grid.clear()
    assert not grid.state().any()


def test_square_follows_the_base(grid: ObstacleGrid, seen: ColumnEvidence) -> None:
    for n in range(20):
        grid.update(n * PERIOD_NS, np.eye(4), seen)
    far = np.eye(4)
    far[0, 3] = 50.0
    ring = grid.update(20 * PERIOD_NS, far, seen)
    assert np.abs(grid.corner_m - [50.0 - 6.4, -6.4]).max() < 0.1 and not np.isfinite(ring.ranges_m).any()
