"""Compiled view of a landmark in both panoramas, and its derivatives."""

from __future__ import annotations

import numpy as np

from calib.panorama import Cylinder
from omnid.core.odometry.view_kernels import linearise
from omnid.core.types.stereo_model import StereoModel

MODEL = StereoModel(Cylinder(1304, 383, 128.5), 0.2, sigma_px=0.2)


def test_errors_wrap_at_the_seam() -> None:
    T, J, error = np.eye(4), np.zeros((3, 6)), np.zeros(3)
    for column in (0.0, 1303.5):
        linearise(np.array([-2.0, 0.001, 0.1]), np.array([column, 0, np.nan]), MODEL.camera, T, J, error)
        assert abs(error[0]) < 2 and error[2] == 0
