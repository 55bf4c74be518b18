"""Mask of rim, hub and struts from a stack of rendered frames."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from calib.errors import CalibError
from calib.masks.stack_mask import find_mask
from calib.models.camera import Mask
from omnid.simulation.rendering.sensor import MountedSensor, Sensor
from omnid.simulation.rendering.textures import value_noise

CENTER, RIM = (201.4, 197.2), 176.0
SIZE = (400, 396)
SENSOR = Sensor(strut_angles_deg=(20.0, 140.0, 260.0), strut_width=0.03, hub=0.08)


def frames(count: int, sensor: Sensor = SENSOR) -> list[NDArray[np.uint8]]:
    ring = Mask(CENTER, 0.0, RIM)
    exposure, rng = MountedSensor.of(sensor, ring, SIZE), np.random.default_rng(2)
    v, u = np.indices(SIZE[::-1])
    inside = np.hypot(u - CENTER[0], v - CENTER[1]) <= RIM
    worlds = [130 + 50 * value_noise(rng, SIZE, 60.0) for _ in range(count)]
    return [exposure.expose(np.where(inside, world, 0).astype(np.float32), rng) for world in worlds]


def test_masks_rim_hub_and_struts() -> None:
    mask = find_mask(frames(10), (205.0, 200.0))
    assert mask.image is not None
    assert mask.center == pytest.approx(CENTER, abs=0.5) and mask.outer_px == pytest.approx(RIM - 1.5, abs=1.0)
    hidden = MountedSensor.of(SENSOR, Mask(CENTER, 0.0, RIM), SIZE).hidden > 0.9
    v, u = np.indices(SIZE[::-1])
    radius = np.hypot(u - CENTER[0], v - CENTER[1])
    assert (mask.image[hidden & (radius < RIM - 6)] == 0).mean() > 0.97
    assert (mask.image[radius > RIM + 1] == 0).all()
    clear = ~hidden & (radius < RIM - 6) & (radius > 45)
    assert (mask.image[clear] > 0).mean() > 0.93


def test_masks_no_strut_without_struts() -> None:
    mask = find_mask(frames(10, Sensor()), (200.0, 198.0))
    assert mask.image is not None
    v, u = np.indices(SIZE[::-1])
    assert (mask.image[np.hypot(u - CENTER[0], v - CENTER[1]) < RIM - 4] > 0).mean() > 0.995


def test_refuses_few_frames_and_frames_without_a_rim() -> None:
    with pytest.raises(CalibError, match="expected at least 5 frames of different views, found 3"):
        find_mask(frames(3), CENTER)
    with pytest.raises(CalibError, match="no rim of a mirror is found"):
        find_mask([np.full((200, 200), 90, np.uint8)] * 6, (100.0, 100.0))
