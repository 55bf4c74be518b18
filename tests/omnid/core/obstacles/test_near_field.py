"""Cells too near to be seen, judged by what is seen behind them."""

from __future__ import annotations

import numpy as np
import pytest

from omnid.core.obstacles.near_field import _over_narrow


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
