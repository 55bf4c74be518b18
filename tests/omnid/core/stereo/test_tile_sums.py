"""Sums over the tiles of a camera's panoramas."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from omnid.core.stereo.tile_sums import SATURATED_GREY, SPACING_PX, TILE_COLUMNS, TILE_ROWS, TileSampler
from tests.omnid.core.scenery import texture

LARGE, SMALL = (256, 960), (80, 240)  # tiles of 64 x 16 and of 20 x 4 pixels


def of_tiles(values: NDArray[np.int64]) -> NDArray[np.int64]:
    """Return the sums (TILE_ROWS, TILE_COLUMNS) of values whose tiles are all of one size."""
    height, width = values.shape[0] // TILE_ROWS, values.shape[1] // TILE_COLUMNS
    return np.asarray(values.reshape(TILE_ROWS, height, TILE_COLUMNS, width).sum(axis=(1, 3)))


@pytest.mark.parametrize(("shape", "spacing_px"), [(LARGE, SPACING_PX), (SMALL, 1)])
def test_sums_are_those_of_the_pixels_that_show_the_world(shape: tuple[int, int], spacing_px: int) -> None:
    """Of a small panorama all pixels count."""
    visible = np.random.default_rng(1).random(shape) < 0.7
    first, second = (texture(seed, shape, 4.0).astype(np.int64).clip(0, 255) for seed in (1, 2))
    first[:20, :40] = 255
    sampler, every = TileSampler(visible), slice(None, None, spacing_px)
    shown = visible[every, every].astype(np.int64)
    before = sampler.add(first.astype(np.uint8))
    a, b = first[every, every], second[every, every]
    assert before.is_first and not before.change.any()
    np.testing.assert_array_equal(before.pixels, of_tiles(shown))
    np.testing.assert_array_equal(before.grey, of_tiles(shown * a))
    np.testing.assert_array_equal(before.square, of_tiles(shown * a**2))
    np.testing.assert_array_equal(before.saturated, of_tiles(shown * (a >= int(SATURATED_GREY))))
    after = sampler.add(second.astype(np.uint8))
    assert not after.is_first
    np.testing.assert_array_equal(after.change, of_tiles(shown * abs(b - a)))


def test_a_panorama_of_another_shape_is_refused() -> None:
    with pytest.raises(ValueError, match="a panorama is"):
        TileSampler(np.ones(LARGE, bool)).add(np.zeros((255, 960), np.uint8))
