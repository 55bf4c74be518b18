"""Cells too near to be seen, judged by what is seen behind them."""

from __future__ import annotations

import numpy as np
import pytest

from omnid.core.obstacles.near_field import SEEN_SURFACE, NearField, _over_narrow


@pytest.mark.parametrize(
    ("ways", "found"),
    [
        ([5, 0, 0, 3, 4], [5, 3, 3, 3, 4]),
        ([5, 0, 0, 0, 4], [5, 0, 0, 0, 4]),  # wider than two directions
        ([0, 7, 7, 7, 0], [7, 7, 7, 7, 7]),  # around the full turn
        ([0, 7, 2, 0, 0], [0, 7, 2, 0, 0]),
        ([0, 0, 0, 0, 0], [0, 0, 0, 0, 0]),
        ([0, 0, 6, 0, 0], [0, 0, 6, 0, 0]),
    ],
)
def test_between_two_directions_that_are_seen_past_nothing_wide_stands(ways: list[int], found: list[int]) -> None:
    assert _over_narrow(np.array(ways), 2).tolist() == found


def test_a_surface_is_surely_shown_where_floor_cannot_be_seen_and_its_evidence_is_clear() -> None:
    """The window begins 10 cells from the corner of the square; the nearest floor in view is 6 cells away."""
    field, eye = NearField(40, 0.05, np.array([[1.0, 0.0]])), np.array([20.5, 20.5])
    surface, in_view = np.zeros((20, 20), np.float32), np.zeros((20, 20), bool)
    surface[10, 14], surface[11, 14], surface[12, 14] = SEEN_SURFACE, SEEN_SURFACE - 1, SEEN_SURFACE
    in_view[12, 14] = True
    surface[10, 19] = SEEN_SURFACE  # farther away
    found = field.surely_shown((slice(10, 30), slice(10, 30)), surface, in_view, eye, 6)
    assert np.argwhere(found).tolist() == [[20, 24]]
