"""A pose needs both witnesses: the tracks from the last sight, and the patches of the keyframes."""

from __future__ import annotations

import numpy as np
import pytest

from calib.panorama import Cylinder
from omnid.core.odometry.corners import corners
from omnid.core.odometry.landmarks import Keyframe, LocalMap
from omnid.core.odometry.pose_estimation import StereoModel
from omnid.core.odometry.pose_search import PoseSearch
from omnid.core.odometry.stereo_frame import StereoFrame
from omnid.core.odometry.tracking import KltSettings
from tests.omnid.core.scenery import texture, wrapped

MODEL = StereoModel(Cylinder(480, 120, 60.0), 0.2)
DISPARITY_PX = 8


@pytest.mark.parametrize(("columns_shown", "supported"), [(480, True), (60, False)])
def test_tracks_alone_do_not_support_a_pose(columns_shown: int, supported: bool) -> None:
    """Seen a moment ago at the same pixels, but most of the second case's keyframe shows something else there."""
    lower = wrapped(texture(1))
    upper = wrapped(np.roll(texture(1), DISPARITY_PX, axis=0))
    usable = np.ones((120, 480), bool)
    usable[:20] = usable[100:] = False
    points = corners(lower, usable, 200)
    views = np.column_stack([points, points[:, 1] + DISPARITY_PX])
    local_map = LocalMap(MODEL, KltSettings())
    shown = np.where(np.arange(480) < columns_shown, texture(1), texture(2))
    keyframe = Keyframe(0, wrapped(shown), np.eye(4), np.zeros((6, 6)))
    local_map.add(keyframe, views, np.zeros((len(views), 2)))
    local_map.saw(lower, np.arange(len(local_map)), local_map.views[:, :2])
    frame = StereoFrame(1, lower, upper, np.full((120, 480), np.nan, np.float32), usable)
    fit = PoseSearch(local_map, MODEL, KltSettings()).from_guess(frame, np.eye(4))
    assert fit is not None and fit.tracked > 100
    assert fit.inliers > 100 if supported else fit.share < 0.4
    if supported:
        np.testing.assert_allclose(fit.T_odom_rect, np.eye(4), atol=1e-3)
