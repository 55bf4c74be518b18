"""What of panoramas is used for odometry: corners, but none on parts that are fixed to the rig."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from calib import se3
from calib.panorama import Cylinder
from omnid.core.odometry.corners import corners
from omnid.core.odometry.static_mask import StaticMask
from omnid.core.types.panorama import PaddedPanorama
from tests.omnid.core.scenery import texture, turned, wrapped

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


Image = NDArray[np.uint8]

STRUT = np.zeros((120, 480), bool)
STRUT[:, 100:116] = STRUT[100:] = True
BETWEEN_PX = 12


def behind_strut(k: int) -> Image:
    """The world after k turns of 12 columns to the left, behind a strut and a rim with scratches on them; noise."""
    image = turned(texture(1), BETWEEN_PX * k)
    image[STRUT] = texture(2)[STRUT] // 2
    return np.clip(image + np.random.default_rng(k).normal(0, 1.5, image.shape), 0, 255).astype(np.uint8)


def turn_of(k: int) -> NDArray[np.float64]:
    return se3.exp([0, 0, 0, 0, 0, BETWEEN_PX * k * 2 * np.pi / 480])


def test_a_strut_is_masked_and_the_moving_world_is_not() -> None:
    mask = StaticMask(Cylinder(480, 120, 60.0))
    for k in range(12):
        mask.observe(behind_strut(k), turn_of(k))
    left = mask.without(ALL)
    assert left[STRUT].mean() < 0.02
    world = ALL.copy()
    world[:, 80:136], world[80:] = False, False
    assert left[world].mean() > 0.97
