"""The floor that a stage uses."""

from __future__ import annotations

import pytest

from omnid.simulation.rendering.rigs import make_rig
from omnid.stages.floor import CameraFloor
from tests.omnid.core.test_floor import HEIGHT_M


def test_the_floor_in_the_base_frame_states_the_height_too() -> None:
    camera_floor = CameraFloor(make_rig(), -HEIGHT_M)
    assert camera_floor.floor is not None and camera_floor.floor.height_m == pytest.approx(HEIGHT_M)
