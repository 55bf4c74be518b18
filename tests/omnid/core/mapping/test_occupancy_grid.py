"""Occupancy grid: occupied, free and unknown cells, size of the cells, memory."""

from __future__ import annotations

import numpy as np
import pytest

from omnid.core.mapping.occupancy_grid import FREE, MAX_CELLS, OCCUPIED, UNKNOWN, Grid, occupancy
from tests.omnid.allocations import taken

NO_POINTS = np.zeros((0, 3)), np.zeros(0)


def at(grid: Grid, x: float, y: float) -> int:
    column, row = (int(np.floor(value / grid.cell_m)) - round(corner / grid.cell_m)
                   for value, corner in zip((x, y), grid.corner, strict=True))
    return int(grid.cells[row, column])


def test_walls_are_occupied_the_path_is_free_the_rest_unknown() -> None:
    wall = np.array([[2.01, y, 0.0] for y in np.arange(-1, 1, 0.04)])
    path = np.array([[0.0, 0.0], [1.0, 0.0], [1.0, 0.5]])
    grid = occupancy(wall, np.full(len(wall), 1.0), path, (-1.0, 1.0), 0.05)
    assert {at(grid, 2.02, y) for y in np.arange(-0.95, 0.9, 0.05)} == {OCCUPIED}
    assert at(grid, 0.5, 0.0) == at(grid, 1.0, 0.3) == FREE
    assert at(grid, 1.5, 0.0) == at(grid, 0.5, 0.3) == UNKNOWN
    assert grid.corner == pytest.approx((0.0, -1.0)) and grid.cells.shape == (40, 41)


def test_negative_coordinates() -> None:
    grid = occupancy(np.array([[-3.33, -2.22, 0.0], [1.0, 4.0, 0.0]]), np.array([0.5, 0.009]), np.zeros((1, 2)),
                     (-1.0, 1.0), 0.1)
    assert at(grid, -3.33, -2.22) == 50 and at(grid, 1.0, 4.0) == 1 and at(grid, 0.0, 0.0) == FREE
    assert (grid.cells != UNKNOWN).sum() == 3


def test_a_cell_has_its_highest_confidence_also_on_the_path() -> None:
    points = np.array([[0.02, 0.02, 0.0], [0.03, 0.01, 0.2], [0.01, 0.03, 0.1]])
    grid = occupancy(points, np.array([0.2, 0.9, 0.4]), np.array([[0.0, 0.0], [0.2, 0.0]]), (-1.0, 1.0), 0.05)
    assert at(grid, 0.0, 0.0) == 90 and at(grid, 0.1, 0.0) == FREE


@pytest.mark.parametrize("point", [[1.0, 1.0, 1.1], [1.0, 1.0, -0.2], [np.nan, 1.0, 0.0], [1e9, 1.0, 0.0]])
def test_leaves_out_points_outside_the_heights_or_the_map(point: list[float]) -> None:
    grid = occupancy(np.array([point]), np.ones(1), np.zeros((1, 2)), (0.0, 1.0), 0.05)
    assert grid.cells.tolist() == [[FREE]]


def test_an_empty_map_is_one_unknown_cell() -> None:
    assert occupancy(*NO_POINTS, np.zeros((0, 2)), (0.0, 1.0), 0.05).cells.tolist() == [[UNKNOWN]]


def test_a_long_path_has_larger_cells() -> None:
    path = np.array([[0.0, 0.0], [5000.0, 3000.0]])
    grid = occupancy(*NO_POINTS, path, (0.0, 1.0), 0.05)
    assert MAX_CELLS / 5 < grid.cells.size <= MAX_CELLS and grid.cell_m == pytest.approx(0.05 * 128)
    assert at(grid, 2500.0, 1500.0) == FREE


def test_a_large_map_needs_little_extra_memory() -> None:
    """A live run makes a grid every two seconds for hours; its peak memory stays with the process."""
    rng = np.random.default_rng(3)
    points = (rng.normal(size=(200_000, 3)) * (5.0, 5.0, 0.3)).astype(np.float32)
    confidence = rng.random(len(points)).astype(np.float32)
    assert taken(lambda: occupancy(points, confidence, np.zeros((9, 2)), (-1.0, 1.5), 0.05)).most < 16 * len(points)
