"""Ways in the small grid about the base."""

from __future__ import annotations

import numpy as np
import pytest

from omnid.core.navigation.grid_ways import CELL_M, FAR_M, HALF_CELLS, grid_distances, neighbours

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
