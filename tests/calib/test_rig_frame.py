"""Construction of a rig from two cameras and the transform between them."""

from __future__ import annotations

import numpy as np
import pytest

from calib import se3
from calib.importers import straight_up
from calib.rig import is_turned_over, rig_between
from tests.calib.test_rig import parabolic_ocam, parabolic_omni
from tests.simulation.rigs import LENSES, lens, lens_rig


def test_rig_between_is_upright_with_x_along_the_image_axis() -> None:
    lower, upper = parabolic_omni().camera, parabolic_ocam().camera
    for camera, T_down in ((lower, parabolic_omni().T_cam_rig), (upper, parabolic_ocam().T_cam_rig)):
        rig = rig_between(camera, camera, straight_up(0.25), ("a", "b"))
        np.testing.assert_allclose(rig.upper.viewpoint, [0, 0, 0.25], rtol=0, atol=1e-15)
        # The image's u axis runs to the robot's left here, and the rig's x is that axis.
        np.testing.assert_allclose(rig.lower.T_cam_rig[:3, 0], T_down[:3, 1], rtol=0, atol=1e-12)


def test_exchanged_mirror_cameras_turn_the_rig_over() -> None:
    for camera in (parabolic_omni().camera, parabolic_ocam().camera):
        assert not is_turned_over(rig_between(camera, camera, straight_up(0.25)))
        assert is_turned_over(rig_between(camera, camera, se3.inverse(straight_up(0.25))))


@pytest.mark.parametrize("model", LENSES)
def test_exchanged_lenses_that_look_ahead_turn_the_rig_over(model: str) -> None:
    rig = lens_rig(lens(model, 90))
    camera = rig.lower.camera
    T_lower_upper = rig.lower.T_cam_rig @ se3.inverse(rig.upper.T_cam_rig)
    assert not is_turned_over(rig) and not is_turned_over(rig_between(camera, camera, T_lower_upper))
    assert is_turned_over(rig_between(camera, camera, se3.inverse(T_lower_upper)))
    up = rig_between(camera, camera, straight_up(0.25))  # such a lens may look up or down
    assert not is_turned_over(up)
