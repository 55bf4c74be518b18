"""Disturbances: each changes what it is named for, and nothing else; the same arguments give the same images."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from calib.models.camera import Mask
from drivers.errors import FrameDecodeError
from drivers.frame import Frame, gray
from omnid.simulation.rendering.sensor import Floats
from tests.simulation.disturbances import Disturbance, DisturbedCamera

SIDE = 160
MASK = Mask((79.5, 79.5), 0.0, 75.0)
IDEAL: Floats = np.random.default_rng(1).uniform(40, 180, (SIDE, SIDE)).astype(np.float32)
LIGHT: tuple[Disturbance, ...] = ("defocus", "chromatic", "flare", "flicker", "gain")


def camera(*names: Disturbance, number: int = 0) -> DisturbedCamera:
    return DisturbedCamera.of(names, number, MASK, (SIDE, SIDE), 5)


def digits(one: DisturbedCamera, pair: int = 3) -> NDArray[np.uint8]:
    return one.digitised(np.rint(IDEAL).astype(np.uint8), pair)


def test_without_a_name_nothing_changes() -> None:
    none = camera()
    assert none.times_s() == [0.0] and none.encoded(digits(none), 0) is None
    assert np.array_equal(none.shown(IDEAL, 0, 0.3), IDEAL) and np.array_equal(digits(none), np.rint(IDEAL))


@pytest.mark.parametrize("name", LIGHT)
def test_light_changes_in_both_cameras_and_is_that_of_the_seed(name: Disturbance) -> None:
    for number in (0, 1):
        seen = camera(name, number=number).shown(IDEAL, 3, 0.3)
        assert np.abs(seen - IDEAL).max() > 1
        assert np.array_equal(seen, camera(name, number=number).shown(IDEAL, 3, 0.3))


def test_jpeg_is_in_colour_with_another_quality_for_each_image() -> None:
    sizes = set()
    for pair in range(4):
        data = camera("jpeg").encoded(digits(camera()), pair)
        assert data is not None
        sizes.add(len(data))
        assert cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED).shape == (SIDE, SIDE, 3)
    assert len(sizes) > 1


def test_restart_markers_are_lost_in_some_images_of_the_upper_camera_only() -> None:
    """With `jpeg` the lower camera has an encoder without them."""
    alone, both = camera("restarts"), [camera("restarts", "jpeg", number=number) for number in (0, 1)]
    assert sum(_is_refused(alone, pair) for pair in range(100)) in range(4, 17)
    assert b"\xff\xd0" not in (both[0].encoded(digits(camera()), 0) or b"\xff\xd0")
    assert [any(_is_refused(one, pair) for pair in range(100)) for one in both] == [False, True]


def _is_refused(one: DisturbedCamera, pair: int) -> bool:
    """True if the image of a pair is not decoded; it has its size in any case, and is otherwise nearly as it was."""
    data = one.encoded(digits(camera()), pair)
    assert data is not None
    assert cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED).shape == (SIDE, SIDE, 3)
    try:
        seen = gray(Frame(pair, 0, "lower", "jpeg", data))
    except FrameDecodeError:
        return True
    assert np.abs(seen.astype(float) - IDEAL).mean() < 20
    return False
