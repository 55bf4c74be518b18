"""Noise and brightness of panoramas."""

from __future__ import annotations

import numpy as np
import pytest

from omnid.core.stereo.photometry import (
    MAX_GAIN,
    TARGET_LEVEL,
    UNKNOWN_NOISE,
    brightened,
    gain_of,
    light,
    noise_sigma,
)
from tests.omnid.core.scenery import texture

SHAPE = (160, 640)
EVERYWHERE = np.ones(SHAPE, bool)


@pytest.mark.parametrize("sigma", [2.0, 5.0, 12.0])
def test_noise_is_measured_beside_texture(sigma: float) -> None:
    rng = np.random.default_rng(1)
    image = 60.0 + 0 * EVERYWHERE
    image[:, 200:] = texture(2, SHAPE, 4.0)[:, 200:]
    # The noise of a panorama is that of the camera, interpolated: neighbours are alike.
    fine = rng.standard_normal((SHAPE[0] + 1, SHAPE[1] + 1))
    noise = fine[:-1, :-1] + fine[1:, :-1] + fine[:-1, 1:] + fine[1:, 1:]
    image += sigma * noise / noise.std()
    found = noise_sigma(np.clip(np.rint(image), 0, 255).astype(np.uint8), EVERYWHERE)
    assert 0.6 * sigma < found < 1.5 * sigma


def test_noise_is_measured_only_where_both_cameras_see() -> None:
    image = np.random.default_rng(3).integers(0, 255, SHAPE).astype(np.uint8)
    image[:, :320] = 90
    left = np.zeros(SHAPE, bool)
    left[:, :320] = True
    assert noise_sigma(image, left & (np.arange(SHAPE[1]) < 300)) < 0.5 < noise_sigma(image, ~left)
    assert noise_sigma(image, ~EVERYWHERE) == UNKNOWN_NOISE


def test_dim_panoramas_are_brought_to_one_level_and_bright_ones_are_left() -> None:
    image = np.full(SHAPE, 30, np.uint8)
    image[:80] = 10
    visible = EVERYWHERE.copy()
    visible[:80] = False
    gain = gain_of(light(image, visible, 1.0).level_grey)
    assert light(brightened(image, gain), visible, 1.0).level_grey == pytest.approx(TARGET_LEVEL, abs=0.5)
    bright = np.full(SHAPE, 120, np.uint8)
    assert brightened(bright, gain_of(light(bright, visible, 1.0).level_grey)) is bright
    assert gain_of(0.0) == MAX_GAIN
