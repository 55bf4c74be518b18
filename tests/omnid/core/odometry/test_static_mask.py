"""Struts turn with the camera and are found out; the world does not."""

from __future__ import annotations

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


def test_a_strut_is_found_and_the_moving_world_stays() -> None:
    pattern = StaticMask()
    for k in range(12):
        pattern.observe(seen(k), pose(k))
    left = pattern.without(ALL)
    assert left[STRUT].mean() < 0.02
    world = ALL.copy()
    world[:, 80:136], world[80:] = False, False
    assert left[world].mean() > 0.97


def test_nothing_is_known_before_enough_was_seen_and_what_was_masked_stays_masked() -> None:
    pattern, masked = StaticMask(), ALL.copy()
    masked[:, 300:] = False
    for k in range(5):
        pattern.observe(seen(k), pose(k))
    assert pattern.without(ALL).all()
    for k in range(5, 12):
        pattern.observe(seen(k), pose(k))
    left = pattern.without(masked)
    assert not left[:, 300:].any() and left[:, :90].any() and masked[:, :300].all()


def test_standing_still_proves_nothing() -> None:
    pattern = StaticMask()
    for _ in range(30):
        pattern.observe(seen(0), pose(0))
    assert pattern.without(ALL).all()


def test_a_shift_is_motion_too() -> None:
    pattern = StaticMask()
    for k in range(12):
        pattern.observe(seen(k), se3.exp([0.3 * k, 0, 0, 0, 0, 0]))
    assert not pattern.without(ALL)[:, 100:116].any()


def test_bare_walls_keep_their_level_and_are_no_strut() -> None:
    """Images on white walls: nearly all of the panorama stays the same, and none of it is fixed."""
    room = np.full((120, 480), 200, np.uint8)
    for column in (30, 170, 330):
        room[40:80, column : column + 40] = texture(3)[40:80, column : column + 40]
    pattern = StaticMask()
    for k in range(40):
        pattern.observe(turned(room, BETWEEN_PX * k), pose(k))
    assert pattern.without(ALL).mean() > 0.97


def test_what_was_taken_for_fixed_is_given_back_when_it_changes() -> None:
    pattern = StaticMask()
    for k in range(12):
        pattern.observe(seen(k), pose(k))
    for k in range(12, 30):
        pattern.observe(turned(texture(1), BETWEEN_PX * k), pose(k))
    assert pattern.without(ALL).mean() > 0.97
