"""Images of drives become those of real cameras, and follow from the seed alone."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from drivers.frame import Frame, gray
from omnid.simulation.robot import make_robot
from tests.bench.real_lenses import with_real_lenses

SIZE_PX = 128


def test_images_are_disturbed_alike_for_a_seed() -> None:
    plain = Frame(3, 0, "upper", "mono8", np.full(SIZE_PX * SIZE_PX, 120, np.uint8), SIZE_PX, SIZE_PX)
    robot, disturbed = with_real_lenses(make_robot(SIZE_PX), seed=5)
    again, other = (with_real_lenses(make_robot(SIZE_PX), seed=seed)[1] for seed in (5, 6))
    image = gray(disturbed(0.3, plain))
    assert image.shape == (SIZE_PX, SIZE_PX)
    assert image.std() > 5  # dust, scattered light, fixed pattern, noise
    assert np.array_equal(image, gray(again(0.3, plain)))
    assert not np.array_equal(image, gray(other(0.3, plain)))
    assert robot.sensor.noise_sigma == 0.0  # It is added after what lenses do, as in a sensor.


def test_cameras_have_dust_and_drops_of_their_own() -> None:
    _, disturbed = with_real_lenses(make_robot(SIZE_PX), seed=5)
    lower, upper = (
        gray(disturbed(0.3, Frame(3, 0, camera, "mono8", _ramp(), SIZE_PX, SIZE_PX))) for camera in ("lower", "upper")
    )
    assert np.abs(lower.astype(int) - upper).max() > 30


def _ramp() -> NDArray[np.uint8]:
    return np.tile(np.linspace(40, 200, SIZE_PX).astype(np.uint8), SIZE_PX)
