"""Structure that is fixed to the rig is detected; the world is not."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from calib import se3
from omnid.core.odometry.static_mask import StaticMask
from tests.omnid.core.scenery import texture, turned

Image = NDArray[np.uint8]

ALL = np.ones((120, 480), bool)
STRUT = np.zeros((120, 480), bool)
STRUT[:, 100:116] = STRUT[100:] = True
BETWEEN_PX = 12


def seen(k: int) -> Image:
    """The world after k turns of 12 columns to the left, behind a strut and a rim with scratches on them; noise."""
    image = turned(texture(1), BETWEEN_PX * k)
    image[STRUT] = texture(2)[STRUT] // 2
    return np.clip(image + np.random.default_rng(k).normal(0, 1.5, image.shape), 0, 255).astype(np.uint8)


def pose(k: int) -> NDArray[np.float64]:
    return se3.exp([0, 0, 0, 0, 0, BETWEEN_PX * k * 2 * np.pi / 480])


def test_a_strut_is_masked_and_the_moving_world_is_not() -> None:
    mask = StaticMask()
    for k in range(12):
        mask.observe(seen(k), pose(k))
    left = mask.without(ALL)
    assert left[STRUT].mean() < 0.02
    world = ALL.copy()
    world[:, 80:136], world[80:] = False, False
    assert left[world].mean() > 0.97


def test_bare_walls_are_not_masked() -> None:
    """Images on white walls: nearly all of the panorama stays the same, and none of it is fixed."""
    room = np.full((120, 480), 200, np.uint8)
    for column in (30, 170, 330):
        room[40:80, column : column + 40] = texture(3)[40:80, column : column + 40]
    mask = StaticMask()
    for k in range(40):
        mask.observe(turned(room, BETWEEN_PX * k), pose(k))
    assert mask.without(ALL).mean() > 0.97


def test_the_world_in_a_small_panorama_is_not_masked() -> None:
    """Between two turns of 4.5 degrees it moves by 3 of 240 columns only, and many pixels keep their grey."""
    mask, world = StaticMask(), cv2.resize(texture(1), (240, 60), interpolation=cv2.INTER_AREA)
    world = cv2.normalize(cv2.GaussianBlur(world, (0, 0), 2), None, 60, 200, cv2.NORM_MINMAX)
    for k in range(30):
        mask.observe(turned(world, 3 * k), se3.exp([0, 0, 0, 0, 0, 3 * k * 2 * np.pi / 240]))
    assert mask.without(np.ones(world.shape, bool)).mean() > 0.95
