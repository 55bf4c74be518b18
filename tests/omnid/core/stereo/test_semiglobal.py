"""Semi-global prior, and the search near it to fractions of a pixel."""

from __future__ import annotations

import numpy as np
import pytest

from omnid.core.stereo.semiglobal import REACH_PX, SemiGlobalPrior, WarpedSad, refined
from tests.omnid.core.scenery import texture

SHAPE, SHIFT_PX = (120, 240), 6
LOWER = texture(1, SHAPE, 1.2)
INNER = (slice(20, -20), slice(20, -20))


def test_the_prior_is_good_to_a_pixel() -> None:
    disparity, known = SemiGlobalPrior(32).disparity(LOWER, np.roll(LOWER, SHIFT_PX, axis=0))
    assert disparity.shape == known.shape == SHAPE and known[INNER].mean() > 0.95
    assert np.median(np.abs(disparity[INNER] - SHIFT_PX)) < 0.3
    assert (np.abs(disparity[INNER][known[INNER]] - SHIFT_PX) < 1.0).mean() > 0.97


def test_nothing_is_known_without_texture() -> None:
    grey = np.full(SHAPE, 90, np.uint8)
    disparity, _ = SemiGlobalPrior(32).disparity(grey, grey)
    assert np.isfinite(disparity).all() and disparity.max() == 0


@pytest.mark.parametrize("error_px", [-1.5, 0.0, 0.5, 1.5])
def test_the_search_near_a_prior_corrects_it(error_px: float) -> None:
    upper = np.roll(LOWER, SHIFT_PX, axis=0)
    prior = np.full(SHAPE, SHIFT_PX + error_px, np.float32)
    pixels = np.flatnonzero(np.pad(np.ones((80, 200), bool), 20))
    costs = WarpedSad(SHAPE, 7).costs(LOWER, upper, prior, pixels)
    assert costs.shape == (2 * REACH_PX + 1, len(pixels))
    found = refined(prior, pixels, costs, np.argmin(costs, axis=0))
    assert (np.abs(found - SHIFT_PX) < 0.3).mean() > 0.95
