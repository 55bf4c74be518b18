"""Noise and brightness of panoramas."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from omnid.core.stereo.photometry import (
    MAX_GAIN,
    TARGET_LEVEL,
    brightened,
    gain_of,
    light,
    noise_sigma,
    pair_gains,
)
from omnid.core.stereo.tiles import TileSampler, TileSums
from tests.omnid.core.scenery import texture

SHAPE = (160, 640)
EVERYWHERE = np.ones(SHAPE, bool)


def sums_of(image: NDArray[np.uint8], visible: NDArray[np.bool_] = EVERYWHERE) -> TileSums:
    return TileSampler(visible).add(image)


def gains_of(lower: NDArray[np.uint8], upper: NDArray[np.uint8], gains: tuple[float, float]) -> tuple[float, float]:
    return pair_gains(sums_of(lower), sums_of(upper), gains)


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


def test_dim_panoramas_are_brought_to_one_level_and_bright_ones_are_left() -> None:
    image = np.full(SHAPE, 30, np.uint8)
    image[:80] = 10
    visible = EVERYWHERE.copy()
    visible[:80] = False
    gain = gain_of(light(sums_of(image, visible), 1.0).level_grey)
    assert light(sums_of(brightened(image, gain), visible), 1.0).level_grey == pytest.approx(TARGET_LEVEL, abs=0.5)
    bright = np.full(SHAPE, 120, np.uint8)
    assert brightened(bright, gain_of(light(sums_of(bright, visible), 1.0).level_grey)) is bright
    assert gain_of(0.0) == MAX_GAIN


@pytest.mark.parametrize("share", [1.0, 0.95, 0.6, 0.3])
def test_the_dimmer_panorama_of_a_pair_becomes_as_bright_as_the_other(share: float) -> None:
    lower = (20 + texture(2, SHAPE, 4.0)).clip(0, 250)
    pair = lower.astype(np.uint8), (share * np.roll(lower, 6, axis=0)).astype(np.uint8)
    gains = gains_of(*pair, (1.0, 1.0))
    assert gains == (1.0, 1.0 if share > 0.9 else pytest.approx(1 / share, rel=0.03))
    assert gains_of(*pair[::-1], (1.0, 1.0)) == pytest.approx(gains[::-1])
    # A dim pair has gains already, and a third of one camera behind a hand is no dimmer image.
    assert gains_of(*pair, (1.5, 1.5 / share)) == (1.5, 1.5 / share)
    pair[1][:, : SHAPE[1] // 3] = 5
    assert gains_of(*pair, (1.0, 1.0)) == pytest.approx(gains, rel=0.03)
    # Two thirds behind it leave no more than a third that shows the brightness.
    pair[1][:, : 2 * SHAPE[1] // 3] = 5
    assert share < 0.9 or gains_of(*pair, (1.0, 1.0)) == (1.0, 1.0)
