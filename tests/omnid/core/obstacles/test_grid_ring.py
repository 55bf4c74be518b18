"""The ring by drawn cells: ranges, and the end of the free floor."""

from __future__ import annotations

import numpy as np
import pytest

from omnid.core.mapping.range_scan import SECTORS, azimuths
from omnid.core.obstacles.grid import END_M, GridRing, RingView, circle_from, ring_of
from omnid.core.obstacles.usual_floor import Arrivals

CELLS, CELL_M, MAX_RANGE_M = 120, 0.05, 2.5
MIDDLE = CELLS // 2
NEAREST_M = np.full(SECTORS, 0.8)
VIEW = RingView(np.full(2, MIDDLE + 0.5), azimuths(), CELL_M, MAX_RANGE_M, NEAREST_M, gap_share=0.07, gap_m=0.1)
NOTHING = np.full(SECTORS, np.nan, np.float32)
ARRIVALS = Arrivals(NOTHING, NOTHING, np.zeros(SECTORS, bool))
AHEAD, LEFT, BEHIND = SECTORS // 2, 3 * SECTORS // 4, 0


def ring(cells: np.ndarray) -> GridRing:
    return ring_of(cells, VIEW, ARRIVALS)


@pytest.fixture
def free() -> np.ndarray:
    return np.ones((CELLS, CELLS), np.uint8)


def ahead(from_m: float, to_m: float) -> tuple[slice, slice]:
    """Return the cells ahead, half a metre wide, from a distance to another one."""
    first, last = (MIDDLE + round(way_m / CELL_M) for way_m in (from_m, to_m))
    return slice(MIDDLE - 5, MIDDLE + 6), slice(first, last)


def test_open_floor_is_open_in_all_directions(free: np.ndarray) -> None:
    found = ring(free)
    assert np.isposinf(found.ranges_m).all() and np.isnan(found.sigma_m).all()
    assert found.free_m.min() == pytest.approx(MAX_RANGE_M - END_M, abs=CELL_M)


def test_the_range_is_that_of_the_first_taken_cell(free: np.ndarray) -> None:
    free[ahead(1.0, 1.2)] = 2
    found = ring(free)
    assert found.ranges_m[AHEAD] == found.free_m[AHEAD] == pytest.approx(1.0, abs=CELL_M)
    assert np.isposinf(found.ranges_m[[LEFT, BEHIND]]).all()


def test_part_of_a_surface_that_shows_nothing_is_no_opening_unless_floor_is_seen_in_it(free: np.ndarray) -> None:
    """Behind it, in the object, is a cell that was taken by an error of range."""
    around, beyond = ahead(0.6, 0.65), ahead(0.9, 0.95)
    free[ahead(0.6, 1.5)], free[around], free[beyond] = 0, 2, 2
    free[MIDDLE - 1 : MIDDLE + 2, around[1]] = 0
    assert ring(free).ranges_m[AHEAD] == pytest.approx(0.6, abs=CELL_M)
    free[MIDDLE - 1 : MIDDLE + 2, around[1].start : beyond[1].start] = 1
    assert ring(free).ranges_m[AHEAD] == pytest.approx(0.9, abs=CELL_M)
    # What is as wide as a person is an opening.
    free[ahead(0.6, 0.9)] = 0
    free[MIDDLE - 5, around[1]] = free[MIDDLE + 5, around[1]] = 2
    assert ring(free).ranges_m[AHEAD] == pytest.approx(0.9, abs=CELL_M)


def test_the_free_floor_ends_at_what_is_unknown_unless_it_is_a_gap(free: np.ndarray) -> None:
    free[ahead(1.0, 1.1)] = 0
    assert ring(free).free_m[AHEAD] > 2.0
    free[ahead(1.0, 1.3)] = 0
    found = ring(free)
    assert np.isnan(found.ranges_m[AHEAD]) and found.free_m[AHEAD] == pytest.approx(1.0 - END_M, abs=CELL_M)


def test_an_end_nearer_than_the_floor_in_view_was_found_before_to_a_cell(free: np.ndarray) -> None:
    free[ahead(0.4, 0.7)] = 0
    assert ring(free).free_m[AHEAD] == pytest.approx(0.4 - CELL_M, abs=0.5 * CELL_M)
    # An end just beyond the nearest floor in view is never told nearer than one at that floor.
    free[:] = 1
    free[ahead(0.85, 1.2)] = 0
    assert ring(free).free_m[AHEAD] == pytest.approx(VIEW.nearest_m - CELL_M, abs=0.01)


def test_the_way_to_a_circle_depends_on_the_direction_where_its_middle_lies_ahead() -> None:
    directions = np.array([[1.0, 0.0], [-1.0, 0.0], [0.0, 1.0]])
    ways_m = circle_from(directions, np.array([0.3, 0.0]), 0.5)
    assert ways_m == pytest.approx([0.8, 0.2, 0.4])
