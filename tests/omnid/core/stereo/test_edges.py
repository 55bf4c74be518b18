"""Which pixels are worth matching."""

from __future__ import annotations

import numpy as np

from omnid.core.stereo.edges import edge_pixels, smooth
from tests.omnid.core.scenery import texture

EVERYWHERE = np.ones((60, 80), bool)


def step(levels: int) -> np.ndarray:
    """Dark above row 30, brighter by some grey levels from there on, and a vertical edge that no column can see."""
    image = np.full((60, 80), 60, np.uint8)
    image[30:] += levels
    image[:, 40:] += 60
    return image


def test_a_horizontal_edge_is_found_once_a_column_and_a_vertical_one_not_at_all() -> None:
    found = edge_pixels(smooth(step(40), 0.8), EVERYWHERE, 40, 10_000)
    rows, columns = np.divmod(found, 80)
    assert set(rows) <= {29, 30}
    np.testing.assert_array_equal(np.sort(columns), np.arange(80))


def test_the_threshold_counts_eight_for_a_grey_level_and_pixel() -> None:
    column = np.array([0] * 20 + [10, 20, 30] + [30] * 37, np.uint8)  # 10 a pixel: a response of 80 in the middle
    ramp = np.tile(column[:, None], (1, 80))
    assert len(edge_pixels(ramp, EVERYWHERE, 78, 10_000)) == 80
    assert len(edge_pixels(ramp, EVERYWHERE, 82, 10_000)) == 0


def test_only_valid_pixels_in_ascending_order() -> None:
    valid = np.zeros((60, 80), bool)
    valid[10:50, 20:70] = True
    found = edge_pixels(texture(1, (60, 80)), valid, 20, 10_000)
    assert len(found) > 50
    assert valid.reshape(-1)[found].all()
    assert (np.diff(found) > 0).all()


def test_the_limit_thins_out_evenly() -> None:
    image = texture(2, (60, 80))
    everything, few = (edge_pixels(image, EVERYWHERE, 20, limit) for limit in (10_000, 60))
    assert len(everything) > 300
    assert 30 < len(few) <= 60
    assert set(few) <= set(everything)
    np.testing.assert_array_less(5, np.histogram(few // 80, bins=4, range=(0, 60))[0])
    assert len(edge_pixels(image, EVERYWHERE, 2000, 10)) == 0


def test_smoothing_takes_noise_away_and_zero_leaves_the_image_alone() -> None:
    noise = np.random.default_rng(3).integers(0, 256, (60, 80)).astype(np.uint8)
    assert smooth(noise, 1.5).std() < noise.std() / 3
    assert smooth(noise, 0.0) is noise
