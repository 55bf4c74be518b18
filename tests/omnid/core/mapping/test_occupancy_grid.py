"""The map as a grid of cells."""

from __future__ import annotations

import numpy as np
import pytest

from omnid.core.mapping.occupancy_grid import FREE, MOST_CELLS, TAKEN, UNKNOWN, Grid, occupancy
from tests.omnid.allocations import taken

NOBODY = np.zeros((0, 3)), np.zeros(0)


def at(grid: Grid, x: float, y: float) -> int:
    column, row = (int(np.floor(value / grid.cell_m)) - round(corner / grid.cell_m)
                   for value, corner in zip((x, y), grid.corner, strict=True))
    return int(grid.cells[row, column])


def test_walls_the_way_and_the_unknown() -> None:
    wall = np.array([[2.01, y, 0.0] for y in np.arange(-1, 1, 0.04)])
    path = np.array([[0.0, 0.0], [1.0, 0.0], [1.0, 0.5]])
    grid = occupancy(wall, np.full(len(wall), 1.0), path, (-1.0, 1.0), 0.05)
    assert {at(grid, 2.02, y) for y in np.arange(-0.95, 0.9, 0.05)} == {TAKEN}
    assert at(grid, 0.5, 0.0) == at(grid, 1.0, 0.3) == FREE
    assert at(grid, 1.5, 0.0) == at(grid, 0.5, 0.3) == UNKNOWN
    assert grid.corner == pytest.approx((0.0, -1.0)) and grid.cells.shape == (40, 41)


def test_negative_places_and_corners() -> None:
    grid = occupancy(np.array([[-3.33, -2.22, 0.0], [1.0, 4.0, 0.0]]), np.array([0.5, 0.009]), np.zeros((1, 2)),
                     (-1.0, 1.0), 0.1)
    assert at(grid, -3.33, -2.22) == 50 and at(grid, 1.0, 4.0) == 1 and at(grid, 0.0, 0.0) == FREE
    assert (grid.cells != UNKNOWN).sum() == 3


def test_the_surest_point_of_a_cell_counts_and_a_wall_across_the_way_stays() -> None:
    points = np.array([[0.02, 0.02, 0.0], [0.03, 0.01, 0.2], [0.01, 0.03, 0.1]])
    grid = occupancy(points, np.array([0.2, 0.9, 0.4]), np.array([[0.0, 0.0], [0.2, 0.0]]), (-1.0, 1.0), 0.05)
    assert at(grid, 0.0, 0.0) == 90 and at(grid, 0.1, 0.0) == FREE


@pytest.mark.parametrize("point", [[1.0, 1.0, 1.1], [1.0, 1.0, -0.2], [np.nan, 1.0, 0.0], [1e9, 1.0, 0.0]])
def test_what_is_too_high_too_low_or_no_place_is_left_out(point: list[float]) -> None:
    grid = occupancy(np.array([point]), np.ones(1), np.zeros((1, 2)), (0.0, 1.0), 0.05)
    assert grid.cells.tolist() == [[FREE]]


def test_nothing_at_all() -> None:
    assert occupancy(*NOBODY, np.zeros((0, 2)), (0.0, 1.0), 0.05).cells.tolist() == [[UNKNOWN]]


def test_a_long_way_has_larger_cells() -> None:
    path = np.array([[0.0, 0.0], [5000.0, 3000.0]])
    grid = occupancy(*NOBODY, path, (0.0, 1.0), 0.05)
    assert MOST_CELLS / 5 < grid.cells.size <= MOST_CELLS and grid.cell_m == pytest.approx(0.05 * 128)
    assert at(grid, 2500.0, 1500.0) == FREE


def test_a_large_map_takes_little_in_passing() -> None:
    """It is made every two seconds while the map grows for hours; what it takes stays with the process."""
    rng = np.random.default_rng(3)
    points = (rng.normal(size=(200_000, 3)) * (5.0, 5.0, 0.3)).astype(np.float32)
    confidence = rng.random(len(points)).astype(np.float32)
    assert taken(lambda: occupancy(points, confidence, np.zeros((9, 2)), (-1.0, 1.5), 0.05)).most < 16 * len(points)
