"""Evidence of columns: where the wall, the floor and a lower floor are, and that a plain one shows nothing."""

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

WALL_M = 2.0

pytestmark = pytest.mark.slow  # its functions are compiled first


@pytest.fixture(scope="module")
def columns() -> Columns:
    return Columns(CYLINDER, BASELINE_M, floor_plane(T_RECT_BASE, 0.0), HeightBand(0.06, 1.3, 0.05), (0.5, 6.0))


def evidence(columns: Columns, floor: Pattern, wall: Pattern, drop_m: float = 0.0) -> ColumnEvidence:
    visible = np.zeros((CYLINDER.height, CYLINDER.width), bool)
    visible[8:-8] = True
    return columns.evidence(*panoramas(floor, WALL_M, wall, drop_m), visible)


def bin_of(range_m: float) -> int:
    return int(CYLINDER.focal_px * BASELINE_M / range_m)


def test_floor_plane_of_an_upright_rig_is_level() -> None:
    assert floor_plane(T_RECT_BASE, 0.0) == pytest.approx((HEIGHT_M, 0.0, 0.0))


def test_wall_and_the_floor_before_it_are_found_in_all_directions(columns: Columns) -> None:
    found = evidence(columns, stains, striped)
    assert (np.abs(np.argmax(found.surface, axis=0) - bin_of(WALL_M)) <= 1).mean() > 0.95
    before, behind = found.floor[bin_of(1.6) : bin_of(1.1)], found.floor[bin_of(4.0) : bin_of(2.5)]
    assert (before > 0).mean() > 0.9 and (behind < 0).mean() > 0.95
    assert (found.surface[bin_of(1.5) :] > 60).mean() < 0.01


def test_plain_wall_and_plain_floor_are_no_evidence(columns: Columns) -> None:
    found = evidence(columns, plain, plain)
    assert np.percentile(found.surface, 99.5) < 60
    assert np.percentile(found.floor, 95) < 40


def test_floor_that_is_lower_is_below_and_no_floor(columns: Columns) -> None:
    level, lower = evidence(columns, stains, striped), evidence(columns, stains, striped, 0.15)
    rows = slice(bin_of(1.6), bin_of(1.1))
    assert np.median(level.below[rows]) < 0 < np.median(lower.below[rows])
    assert np.median(lower.floor[rows]) < 0 < np.median(level.floor[rows])


def test_pixels_that_may_not_be_compared_are_no_evidence(columns: Columns) -> None:
    visible = np.zeros((CYLINDER.height, CYLINDER.width), bool)
    visible[8:-8, :400] = True
    lower, upper = panoramas(stains, WALL_M, striped)
    found = columns.evidence(lower, upper, visible)
    assert not found.surface[:, 400:].any() and not found.floor[:, 400:].any() and not found.below[:, 400:].any()
    assert found.surface[:, :400].any()
