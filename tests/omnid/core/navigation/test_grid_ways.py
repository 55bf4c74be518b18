"""Ways in the small grid about the base."""

from __future__ import annotations

import math

import numpy as np
import pytest

from omnid.core.navigation.grid_ways import (
    CELL_M,
    FAR_M,
    HALF_CELLS,
    descent,
    grid_distances,
    neighbours,
    to_cells,
    wave_front,
)

SIZE = 2 * HALF_CELLS + 1


@pytest.mark.parametrize("point", [(-0.1, 3.0), (3.0, -0.1), (6.6, 3.0), (3.0, 6.6), (-0.1, 9.0)])
def test_points_beyond_the_grid_do_not_count(point: tuple[float, float]) -> None:
    corner = np.array([-1.0, 4.0])
    outside, inside = corner + np.array([point]), corner + np.array([(2.0, 1.0)])
    assert (grid_distances(outside, corner) == FAR_M).all()
    both = grid_distances(np.vstack([outside, inside]), corner)
    np.testing.assert_array_equal(both, grid_distances(inside, corner))
    assert both[20, 40] == 0.0 and both[20, 46] == pytest.approx(6 * CELL_M), "rows are y"


def test_each_cell_is_joined_to_the_eight_around_it() -> None:
    edges = neighbours()
    rows, columns = (edges.second // SIZE - edges.first // SIZE, edges.second % SIZE - edges.first % SIZE)
    assert np.abs(rows).max() == np.abs(columns).max() == 1
    np.testing.assert_allclose(edges.length_m, CELL_M * np.hypot(rows, columns))
    assert len(np.unique(edges.first.astype(np.int64) * SIZE**2 + edges.second)) == len(edges.first)
    counts = np.bincount(edges.first).reshape(SIZE, SIZE)
    assert (counts[1:-1, 1:-1] == 8).all() and counts[0, 0] == counts[-1, -1] == 3 and counts[0, 1] == 5


def test_the_way_left_goes_around_what_is_occupied_and_counts_narrow_places_as_longer() -> None:
    edges, is_free, weight = neighbours(), np.ones((SIZE, SIZE), bool), np.ones((SIZE, SIZE))
    is_free[30, :100] = False  # a wall with an end
    is_free[60:63, 60:63] = False
    is_free[61, 61] = True  # enclosed
    weight[10:15, :] = 3.0
    column, row = 40, 20
    left_m = wave_front(edges, is_free, weight, np.array([column, row]))
    assert left_m is not None and left_m.shape == (SIZE, SIZE)
    assert left_m[20, 40] == 0.0 and left_m[20, 47] == pytest.approx(7 * CELL_M)
    assert left_m[26, 34] == pytest.approx(6 * math.sqrt(2) * CELL_M)
    assert left_m[24, 47] == pytest.approx((3 + 4 * math.sqrt(2)) * CELL_M)
    assert left_m[9, 40] == pytest.approx((6 + 5 * 3.0) * CELL_M), "through the narrow strip"
    around = (60 + 10 * math.sqrt(2)) * CELL_M
    assert left_m[40, 100] == pytest.approx(around)
    assert left_m[31, 40] > 2 * 55 * CELL_M and left_m[31, 40] < FAR_M, "behind the wall"
    assert left_m[61, 61] == FAR_M == left_m[30, 40] == left_m[60, 60]
    assert wave_front(edges, is_free, weight, np.array([40, 30])) is None
    assert wave_front(edges, is_free, weight, np.array([30, 40])) is not None


@pytest.mark.parametrize("k", range(16))
def test_the_way_left_falls_most_in_the_direction_of_its_slope(k: int) -> None:
    angle = 2 * math.pi * k / 16
    rows, columns = np.mgrid[:SIZE, :SIZE]
    plane = 50.0 - math.cos(angle) * columns - math.sin(angle) * rows
    cells = np.array([5, 64, SIZE - 6])
    found = descent(plane, cells, cells[::-1])
    assert np.abs(np.remainder(found - angle + math.pi, 2 * math.pi) - math.pi).max() < math.radians(23)
    assert np.isfinite(descent(plane, np.array([0, SIZE - 1]), np.array([SIZE - 1, 0]))).all(), "at its border"


def test_a_cell_is_that_with_the_nearest_centre_and_beyond_the_grid_that_at_its_border() -> None:
    corner = np.array([-3.2, 1.0])
    points = np.array([(-3.2, 1.0), (-3.13, 1.12), (-9.0, 99.0), (99.0, 0.0)])
    np.testing.assert_array_equal(to_cells(points, corner), [(0, 0), (1, 2), (0, SIZE - 1), (SIZE - 1, 0)])
