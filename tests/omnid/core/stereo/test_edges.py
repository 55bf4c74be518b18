"""Edge detection: response along the column, threshold, thinning, smoothing."""

from __future__ import annotations

import numpy as np

from omnid.core.stereo.matcher import edge_pixels, smooth
from tests.omnid.core.scenery import texture

EVERYWHERE = np.ones((60, 80), bool)


def step(levels: int) -> np.ndarray:
    """Return an image that is brighter from row 30 on by some grey levels, with a vertical edge at column 40."""
    image = np.full((60, 80), 60, np.uint8)
    image[30:] += levels
    image[:, 40:] += 60
    return image


def test_finds_a_horizontal_edge_once_per_column_and_no_vertical_edge() -> None:
    found = edge_pixels(smooth(step(40), 0.8), EVERYWHERE, 40, 10_000)
    rows, columns = np.divmod(found, 80)
    assert set(rows) <= {29, 30}
    np.testing.assert_array_equal(np.sort(columns), np.arange(80))


def test_threshold_is_in_units_of_the_sobel_response() -> None:
    column = np.array([0] * 20 + [10, 20, 30] + [30] * 37, np.uint8)  # 10 a pixel: a response of 80 in the middle
    ramp = np.tile(column[:, None], (1, 80))
    assert len(edge_pixels(ramp, EVERYWHERE, 78, 10_000)) == 80
    assert len(edge_pixels(ramp, EVERYWHERE, 82, 10_000)) == 0


def test_returns_valid_pixels_in_ascending_order() -> None:
    valid = np.zeros((60, 80), bool)
    valid[10:50, 20:70] = True
    found = edge_pixels(texture(1, (60, 80)), valid, 20, 10_000)
    assert len(found) > 50
    assert valid.reshape(-1)[found].all()
    assert (np.diff(found) > 0).all()


def test_thins_out_evenly_to_the_limit() -> None:
    image = texture(2, (60, 80))
    everything, few = (edge_pixels(image, EVERYWHERE, 20, limit) for limit in (10_000, 60))
    assert len(everything) > 300
    assert 30 < len(few) <= 60
    assert set(few) <= set(everything)
    np.testing.assert_array_less(5, np.histogram(few // 80, bins=4, range=(0, 60))[0])
    assert len(edge_pixels(image, EVERYWHERE, 2000, 10)) == 0


def test_smoothing_reduces_noise_and_sigma_zero_returns_the_image() -> None:
    noise = np.random.default_rng(3).integers(0, 256, (60, 80)).astype(np.uint8)
    assert smooth(noise, 1.5).std() < noise.std() / 3
    assert smooth(noise, 0.0) is noise
