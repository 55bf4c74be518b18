"""Compiled part of the fit of patches."""

from __future__ import annotations

import numpy as np
import pytest

from omnid.core.odometry import patch_kernels


@pytest.mark.parametrize("count", [1, 2, 3, 8, 57])
def test_median(count: int) -> None:
    """As numpy's, of the first values alone."""
    values = np.random.default_rng(count).integers(0, 20, 60) / 8
    expected = np.median(values[:count])
    assert patch_kernels.median_of(values, count) == expected


def test_cells_repeat_the_border_and_places_that_are_no_numbers_do_no_harm() -> None:
    rng, reach = np.random.default_rng(1), 7
    image = rng.integers(0, 255, (40, 60), np.uint8)
    centres = np.rint(rng.uniform((-10, -10), (70, 50), (200, 2)))
    places = np.vstack([centres, [[np.nan, 5.0], [5.0, np.inf], [1e300, 5.0]]])
    cells = np.empty((len(places), 2 * reach + 1, 2 * reach + 1), np.uint8)
    patch_kernels.cut(image, places, cells)
    padded = np.pad(image, 30, mode="edge")
    for (column, row), cell in zip(centres.astype(int) + 30, cells, strict=False):
        np.testing.assert_array_equal(cell, padded[row - reach : row + reach + 1, column - reach : column + reach + 1])
