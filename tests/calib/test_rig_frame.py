"""Construction of a rig from two cameras and the transform between them."""

from __future__ import annotations

import numpy as np

from calib.rig_frame import rig_between
from calib.transform_file import straight_up
from tests.calib.test_rig import parabolic_ocam, parabolic_omni


def test_rig_between_is_upright_with_x_along_the_image_axis() -> None:
    lower, upper = parabolic_omni().camera, parabolic_ocam().camera
    for camera, T_down in ((lower, parabolic_omni().T_cam_rig), (upper, parabolic_ocam().T_cam_rig)):
        rig = rig_between(camera, camera, straight_up(0.25), ("a", "b"))
        np.testing.assert_allclose(rig.upper.viewpoint, [0, 0, 0.25], rtol=0, atol=1e-15)
        # The image's u axis runs to the robot's left here, and the rig's x is that axis.
        np.testing.assert_allclose(rig.lower.T_cam_rig[:3, 0], T_down[:3, 1], rtol=0, atol=1e-12)
