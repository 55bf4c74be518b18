"""Loops along the directions around a viewpoint."""

from __future__ import annotations

import math

import numpy as np
import pytest

from omnid.core.obstacles import near_field_kernels as kernels

SIDE = 24
EYE = np.array([12.4, 11.6])
AHEAD, LEFT = 0, 1
DIRECTIONS = np.array([[1.0, 0.0], [0.0, 1.0], [math.sqrt(0.5), math.sqrt(0.5)]])


def ahead(step: int) -> tuple[int, int]:
    """Return row and column of a cell ahead of the viewpoint."""
    return math.floor(EYE[1]), math.floor(EYE[0] + step)


def test_cells_before_the_floor_in_view_lose_what_their_direction_does() -> None:
    lost = np.full((SIDE, SIDE), -0.5, np.float32)
    kernels.lose_before(EYE, DIRECTIONS, 4, np.array([1.5, -2.0, 0.0], np.float32), lost)
    assert [float(lost[ahead(step)]) for step in range(1, 6)] == [1.5, 1.5, 1.5, -0.5, -0.5]


def test_of_two_directions_through_a_cell_the_more_hidden_one_counts() -> None:
    almost = np.array([[1.0, 0.0], [math.cos(0.3), math.sin(0.3)]])
    for near in ([2.0, -1.0], [-1.0, 2.0]):
        lost = np.zeros((SIDE, SIDE), np.float32)
        kernels.lose_before(EYE, almost, 3, np.array(near, np.float32), lost)
        assert lost[ahead(1)] == 2.0


@pytest.mark.parametrize(("surface_at", "clear"), [(None, 9), (1, 0), (6, 5), (9, 8)])
def test_floor_and_surfaces_that_are_watched_are_seen_along_a_direction(surface_at: int | None, clear: int) -> None:
    floor, surface, evidence = (np.zeros((SIDE, SIDE), np.float32) for _ in range(3))
    floor[ahead(4)], evidence[ahead(4)] = 2.0, 1.0
    if surface_at is not None:
        for step in (surface_at, 9):  # the first one counts
            surface[ahead(step)], evidence[ahead(step)] = 1.0, 1.0
    behind, ends = np.empty(3, np.uint8), np.empty(3, np.int32)
    ways, least = np.array([4, 9]), np.array([0.4, 1.5, 0.0], np.float32)
    kernels.view_past(floor, surface, evidence, EYE, DIRECTIONS, ways, least, behind, ends)
    assert behind.tolist() == [1, 0, 0] and ends.tolist() == [clear, 9, 9]
    # Neither counts where it is not watched, nor floor nearer than what is behind.
    evidence[:] = 0.0
    kernels.view_past(floor, surface, evidence, EYE, DIRECTIONS, ways, least, behind, ends)
    assert not behind.any() and ends.tolist() == [9, 9, 9]
    evidence[ahead(4)] = 1.0
    kernels.view_past(floor, surface, evidence, EYE, DIRECTIONS, np.array([5, 9]), least, behind, ends)
    assert not behind.any()


def test_cells_are_marked_up_to_the_end_of_each_way() -> None:
    cells = np.zeros((SIDE, SIDE), np.uint8)
    kernels.mark(EYE, DIRECTIONS, np.array([3, 0, 1], np.int32), cells)
    marked = {ahead(1), ahead(2), ahead(3), (math.floor(EYE[1] + math.sqrt(0.5)), math.floor(EYE[0] + math.sqrt(0.5)))}
    assert set(zip(*(found.tolist() for found in np.nonzero(cells)), strict=True)) == marked


def test_cells_out_of_the_square_are_left_out() -> None:
    around = np.zeros((3 * SIDE, 3 * SIDE), np.float32)
    lost = around[SIDE : 2 * SIDE, SIDE : 2 * SIDE].copy()
    kernels.lose_before(EYE, DIRECTIONS, SIDE, np.zeros(3, np.float32), lost)
    cells = np.zeros((SIDE, SIDE), np.uint8)
    kernels.mark(EYE, DIRECTIONS, np.full(3, 2 * SIDE, np.int32), cells)
    assert (lost == 0.0).all() and cells[ahead(11)] == 1 and cells.sum() < 3 * SIDE
