"""Narrow and plain things: one view shows them by the floor that they hide, and none where nothing stands."""

from __future__ import annotations

import numpy as np
import pytest

from omnid.core.mapping.range_scan import SECTORS, FreeRanges
from omnid.core.mapping.scan_grid import NARROW
from omnid.core.obstacles.column import NEAREST_M, Columns, floor_plane
from omnid.core.obstacles.narrow import narrow_m, nothing_narrow
from tests.omnid.core.obstacles.drawn_floor import (
    BASELINE_M,
    CYLINDER,
    T_RECT_BASE,
    Pattern,
    Pole,
    panoramas,
    plain,
    stains,
    striped,
    worn,
)

VISIBLE = np.zeros((CYLINDER.height, CYLINDER.width), bool)
VISIBLE[8:-8] = True
COLUMNS = Columns(CYLINDER, BASELINE_M, floor_plane(T_RECT_BASE), (0.06, 1.3), (NEAREST_M, 6.0), VISIBLE)
AHEAD = SECTORS // 2


def found(pole: Pole | None, floor: Pattern = stains, seed: int = 4) -> FreeRanges:
    pair = panoramas(floor, 3.0, striped, pole=pole, seed=seed)
    return narrow_m(COLUMNS.evidence(*pair).floor, COLUMNS.at_1m)


@pytest.mark.parametrize("grey", [120.0, 190.0, 250.0])
@pytest.mark.parametrize(("range_m", "width_m"), [(1.15, 0.05), (1.3, 0.05), (1.6, 0.06), (1.6, 0.1)])
def test_a_plain_pole_is_found_by_one_pair_where_it_stands(range_m: float, width_m: float, grey: float) -> None:
    ranges_m = found(Pole(range_m, width_m, grey))
    sectors = np.flatnonzero(np.isfinite(ranges_m))
    half = np.degrees(width_m / 2 / range_m)
    assert {AHEAD - 1, AHEAD} <= set(sectors.tolist())
    assert AHEAD - half - 3 < sectors.min() and sectors.max() < AHEAD + half + 3
    near_m = ranges_m[[AHEAD - 1, AHEAD]]
    assert (near_m <= range_m).all() and (near_m + NARROW * near_m**2 >= range_m).all()


@pytest.mark.parametrize("floor", [stains, worn, plain])
def test_nothing_narrow_stands_on_bare_floor(floor: Pattern) -> None:
    for seed in range(5):
        assert np.isinf(found(None, floor, seed)).all()


def test_what_is_out_of_view_is_no_evidence() -> None:
    assert np.array_equal(narrow_m(np.full((50, 480), np.nan, np.float32), COLUMNS.at_1m), nothing_narrow())


def test_the_last_direction_is_beside_the_first() -> None:
    floor = np.full((30, 480), 3.0, np.float32)
    floor[:20, [478, 479, 0, 1]] = 0.0
    ranges_m = narrow_m(floor, COLUMNS.at_1m)
    sectors = np.flatnonzero(np.isfinite(ranges_m))
    # Two directions are judged together at this range.
    assert set(sectors.tolist()) == {SECTORS - 3, SECTORS - 2, SECTORS - 1, 0, 1}
    assert ranges_m[sectors] == pytest.approx(COLUMNS.at_1m / 24)
