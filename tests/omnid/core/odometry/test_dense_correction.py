"""Dense disparities of cameras that are exposed at different times, corrected to the stamp."""

from __future__ import annotations

import numpy as np
import pytest

from omnid.core.odometry.dense_correction import DenseCorrection
from omnid.core.odometry.exposure_times import Exposure, RigVelocity
from omnid.core.types.pixel_times import PixelTimes
from tests.omnid.core.odometry.test_exposure_times import MODEL, SIGMA, TIMES, TWIST

SHAPE = (361, 1200)  # no multiple of the grid


@pytest.mark.parametrize("times", TIMES)
def test_interpolated_corrections_are_those_of_each_pixel(times: PixelTimes) -> None:
    exposure = Exposure(times, RigVelocity(TWIST, SIGMA**2), MODEL)
    rng = np.random.default_rng(2)
    columns, rows = rng.integers(0, SHAPE[1], 500), rng.integers(0, MODEL.cylinder.height, 500)
    disparity = rng.uniform(6, 45, 500).astype(np.float32)
    pixels = np.column_stack([columns, rows]).astype(float)
    views, noise = exposure.corrected(pixels, rows + disparity)
    correction = DenseCorrection.of(exposure, SHAPE)
    found = correction.corrected(columns, rows, disparity)
    assert np.abs(views - np.column_stack([pixels, rows + disparity])).max() > 0.5, "the motion matters"
    assert np.abs(found.views - views).max() < 0.15  # the noise of a dense disparity is 0.5
    expected = noise[:, 1, 1] + noise[:, 2, 2] - 2 * noise[:, 1, 2]
    np.testing.assert_allclose(np.sqrt(found.variance), np.sqrt(expected), rtol=0.3, atol=0.05)
    column_shift = correction.column_shift(48)
    there, _ = exposure.upper_columns(pixels, rows + disparity)
    shift = column_shift.at_infinity[rows, columns + 48] + column_shift.per_disparity[rows, columns + 48] * disparity
    assert np.abs(MODEL.cylinder.wrap(there - columns - shift)).max() < 0.2


def test_the_upper_pixel_of_a_known_depth_is_where_it_is_seen() -> None:
    exposure = Exposure(TIMES[0], RigVelocity(TWIST, SIGMA**2), MODEL)
    pixels, raw = np.array([[300.0, 100.0], [900.0, 200.0], [500.0, 150.0]]), np.array([20.0, 35.0, np.nan])
    views, _ = exposure.corrected(pixels, pixels[:, 1] + raw)
    columns, _ = exposure.upper_columns(pixels, pixels[:, 1] + raw)
    upper, spread_px = exposure.upper_pixels(pixels, views[:, 2] - views[:, 1])
    np.testing.assert_allclose(upper[:2], np.column_stack([columns, pixels[:, 1] + raw])[:2], atol=0.01)
    assert (spread_px[:2] > 0).all() and np.isnan(upper[2]).all()
