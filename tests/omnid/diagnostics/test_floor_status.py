"""Status of the floor: stated, found, not known."""

from __future__ import annotations

import numpy as np

from omnid.diagnostics.part_status import floor_status
from omnid.simulation.rendering.rigs import make_rig
from omnid.stages.obstacles import CameraFloor
from omnid.transport.codec import OK, WARN
from tests.omnid.stages.test_keyframe_scan import depth


def test_the_height_is_published_with_its_origin_and_warns_unless_it_is_stated() -> None:
    stated = floor_status(CameraFloor(make_rig().at_height(0.9), 0.0))
    assert stated.level == OK and stated.values == {"height_m": "0.9", "sigma_m": "0", "tilt_deg": "0"}
    camera_floor = CameraFloor(make_rig(), 0.0)
    unknown = floor_status(camera_floor)
    assert unknown.level == WARN and "nothing is free" in unknown.message and not unknown.values
    camera_floor.add(depth(np.eye(4)))
    found = floor_status(camera_floor)
    assert found.level == WARN and abs(float(found.values["height_m"]) - 1.2) < 0.03
    assert 0.005 < float(found.values["sigma_m"]) < 0.05
