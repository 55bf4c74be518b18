"""Part of an occupancy grid that holds its known cells."""

from __future__ import annotations

import numpy as np

from omnid.core.mapping.occupancy_grid import FREE, OCCUPIED, UNKNOWN, Grid, known_part


def test_the_known_part_keeps_its_place() -> None:
    cells = np.full((6, 8), UNKNOWN, np.int8)
    cells[2, 3], cells[4, 5] = FREE, OCCUPIED
    part = known_part(Grid(cells, 0.5, (-1.0, 10.0)))
    assert part.cells.tolist() == [[FREE, -1, -1], [-1, -1, -1], [-1, -1, OCCUPIED]]
    assert part.corner == (0.5, 11.0) and part.cell_m == 0.5


def test_a_grid_without_known_cells_stays_whole() -> None:
    grid = Grid(np.full((2, 3), UNKNOWN, np.int8), 0.05, (0.0, 0.0))
    assert known_part(grid) is grid
