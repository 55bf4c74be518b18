"""Pose of a board in front of a known camera, and the corner orders that one image cannot distinguish."""

from __future__ import annotations

import numpy as np

from calib.boards.board_pose import board_pose
from calib.boards.marker_board import AprilGrid
from calib.models.camera import Mask
from calib.models.unified import UnifiedCamera
from calib.rig import MountedCamera
from tests.calib.boards.test_marker_finder import rendered

MOUNTED = MountedCamera(
    UnifiedCamera(0.9, (-150.0, 151.0), (241.3, 237.8), (480, 480)), np.eye(4), Mask((241.3, 237.8), 40.0, 232.0)
)


GRID = AprilGrid(4, 3, 0.06, 0.3)


def test_a_corner_far_off_does_not_change_the_pose() -> None:
    made = rendered(GRID)
    spoilt = made.corners.copy()
    spoilt[7] += 25.0
    T = board_pose(MOUNTED.camera, spoilt, GRID)
    assert T is not None
    np.testing.assert_allclose(T, made.T_cam_board, atol=1e-4)
