"""Corners spread over the panorama, and their disparity in the pair."""

from __future__ import annotations

import numpy as np

from omnid.core.odometry.corners import corners
from omnid.core.types.panorama import PaddedPanorama
from tests.omnid.core.scenery import texture, wrapped

ALL = np.ones((120, 480), bool)


def test_a_poster_full_of_contrast_does_not_take_all_corners() -> None:
    faint = (texture(1) // 5 + 100).astype(np.uint8)
    faint[:, 200:280] = texture(2)[:, 200:280]
    found = corners(wrapped(faint), ALL, 100)
    on_poster = (found[:, 0] >= 195) & (found[:, 0] < 285)
    assert len(found) == 100
    assert on_poster.mean() < 0.4
    assert (np.histogram(found[:, 0], bins=10, range=(0, 480))[0] >= 4).all()


def test_noise_is_no_corner() -> None:
    """The threshold follows the noise that the panorama is said to have."""
    noise = np.random.default_rng(2).normal(100, 12, (120, 480))
    image = np.clip(noise, 0, 255).astype(np.uint8)
    image[40:60, 200:230] = 220  # an object
    usable = np.zeros(image.shape, bool)
    usable[10:110] = True
    quiet = wrapped(image)
    noisy = PaddedPanorama(quiet.image, quiet.pad_px, noise_grey=12.0)
    found = corners(noisy, usable, 1000)
    assert len(corners(quiet, usable, 1000)) > 300 > 5 * len(found)
    of_object = np.array([[200.0, 40], [229, 40], [200, 59], [229, 59]])
    assert np.linalg.norm(of_object[:, None] - found[None], axis=2).min(axis=1).max() < 4
