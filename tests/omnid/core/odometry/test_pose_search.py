"""Steps 2 to 4 of the odometry: a pose needs the tracks from the last frame and the patches of the keyframes."""

from __future__ import annotations

import numpy as np
import pytest

from calib import se3
from calib.panorama import Cylinder
from omnid.core.odometry.corners import corners
from omnid.core.odometry.estimates import OdometryLimits, PoseEstimate
from omnid.core.odometry.exposure_times import NO_VELOCITY, Exposure
from omnid.core.odometry.local_map import Keyframe, LocalMap
from omnid.core.odometry.pose_search import PoseSearch
from omnid.core.odometry.stereo_frame import StereoFrame
from omnid.core.odometry.tracking import KltSettings
from omnid.core.types.pixel_times import AT_ONCE
from omnid.core.types.stereo_model import StereoModel
from tests.omnid.core.scenery import Image, motion_errors, texture, wrapped

MODEL = StereoModel(Cylinder(480, 120, 60.0), 0.2)
DISPARITY_PX = 8


def stereo_frame(lower: Image) -> StereoFrame:
    """A frame with the same disparity everywhere; its disparity image is empty."""
    upper = np.roll(lower, DISPARITY_PX, axis=0)
    return StereoFrame(
        1, wrapped(lower), wrapped(upper), np.full(lower.shape, np.nan, np.float32), np.ones(lower.shape, bool)
    )


def map_of(lower: Image, keyframe_image: Image) -> LocalMap:
    """A map with landmarks seen in `lower`, whose keyframe at the origin shows another image."""
    usable = np.ones((120, 480), bool)
    usable[:20] = usable[100:] = False
    points = corners(wrapped(lower), usable, 200)
    local_map = LocalMap(MODEL, KltSettings())
    keyframe = Keyframe(0, wrapped(keyframe_image), np.eye(4), np.zeros((6, 6)))
    views = np.column_stack([points, points[:, 1] + DISPARITY_PX])
    local_map.add_keyframe(keyframe, views, np.zeros((len(views), 2)))
    local_map.update_tracked(wrapped(lower), np.arange(len(local_map)), local_map.table.anchor_pixels)
    return local_map


def located(local_map: LocalMap, frame: StereoFrame) -> PoseEstimate | None:
    """The estimate from a guess at the origin."""
    steps = PoseSearch(local_map, MODEL, OdometryLimits(), KltSettings())
    exposure = Exposure.of(AT_ONCE, NO_VELOCITY, MODEL)
    coarse = steps.coarse(frame, local_map.track(frame.lower, np.eye(4)), np.eye(4), exposure)
    return steps.refine(frame, coarse, exposure) if coarse else None


@pytest.mark.parametrize(("columns_shown", "supported"), [(480, True), (60, False)])
def test_tracks_alone_do_not_support_a_pose(columns_shown: int, supported: bool) -> None:
    """All landmarks are tracked at the same pixels, but most of the second keyframe shows another image there."""
    shown = np.where(np.arange(480) < columns_shown, texture(1), texture(2))
    estimate = located(map_of(texture(1), shown), stereo_frame(texture(1)))
    assert estimate is not None and estimate.tracked > 100
    assert estimate.inliers > 100 if supported else estimate.inlier_ratio < 0.4
    if supported:
        np.testing.assert_allclose(estimate.T_odom_rect, np.eye(4), atol=1e-3)


RECOGNISED_OFF = np.array([0.01, -0.008, 0.004, 0, 0, 0.004])  # m, rad


@pytest.mark.parametrize(("columns_shown", "inliers"), [(480, 60), (60, 50)])
def test_a_recognised_pose_is_refined_and_supported_by_the_patches(columns_shown: int, inliers: int) -> None:
    """A keyframe most of which shows other texture supports the pose with few patches."""
    shown = np.where(np.arange(480) < columns_shown, texture(1), texture(2))
    pose = refined(shown)
    assert pose is not None and (pose.visible, pose.tracked) == (80, 80) and pose.inliers <= inliers
    if columns_shown == 480:
        distance, angle = motion_errors(pose.T_odom_rect, np.eye(4))
        assert distance < 1e-3 and angle < 1e-3 and pose.inliers == inliers and len(pose.landmarks) > 100


def refined(shown: Image) -> PoseEstimate | None:
    """The pose from one that is a centimetre off; the keyframe shows an image."""
    found = PoseEstimate(se3.exp(RECOGNISED_OFF), 1e-4 * np.eye(6), 80, 80, 60)
    steps = PoseSearch(map_of(texture(1), shown), MODEL, OdometryLimits(), KltSettings())
    return steps.refine_recognised(stereo_frame(texture(1)), found, Exposure.of(AT_ONCE, NO_VELOCITY, MODEL))
