"""A recognised pose is refined and supported by the patches of the local map, which tell several poses apart."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from calib import se3
from omnid.core.odometry.estimates import PoseEstimate
from omnid.core.odometry.exposure_times import Exposure
from omnid.core.odometry.exposure_velocity import UNKNOWN_VELOCITY
from omnid.core.odometry.frame_to_map import FrameToMap
from omnid.core.odometry.recognised_pose import likeliest_recognised
from omnid.core.odometry.tracking import KltSettings
from omnid.core.types.pixel_times import AT_ONCE
from tests.omnid.core.odometry.test_frame_to_map import MODEL, map_of, stereo_frame
from tests.omnid.core.scenery import Image, motion_errors, texture

OFF = np.array([0.01, -0.008, 0.004, 0, 0, 0.004])  # m, rad
TURNED = np.array([0, 0, 0, 0, 0, np.pi])
AWAY = np.array([0.5, 0.2, 0, 0, 0, 1.0])


def recognised(xi: NDArray[np.float64], inliers: int) -> PoseEstimate:
    """A pose as keyframes tell it, a centimetre off."""
    return PoseEstimate(se3.exp(xi) @ se3.exp(OFF), 1e-4 * np.eye(6), 80, 80, inliers)


def likeliest(landmarks: Image, shown: Image, *poses: PoseEstimate) -> PoseEstimate | None:
    """The pose of a frame at the origin, where the landmarks were seen, and the keyframe shows an image."""
    steps = FrameToMap(map_of(landmarks, shown), MODEL, KltSettings())
    exposure = Exposure.of(AT_ONCE, UNKNOWN_VELOCITY, MODEL)
    return likeliest_recognised(stereo_frame(landmarks), poses, exposure, steps)


def alike() -> Image:
    """A panorama that is the same after half a turn."""
    half = texture(3, (120, 240))
    return np.hstack([half, half])


def test_the_patches_refine_the_pose_and_settle_which_of_several_it_is() -> None:
    """The other one has more corners, but few patches."""
    pose = likeliest(texture(1), texture(1), recognised(AWAY, 70), recognised(np.zeros(6), 60))
    assert pose is not None and (pose.visible, pose.tracked, pose.inliers) == (80, 80, 60)
    distance, angle = motion_errors(pose.T_odom_rect, np.eye(4))
    assert distance < 1e-3 and angle < 1e-3 and len(pose.landmarks) > 100


@pytest.mark.parametrize(("columns_shown", "inliers"), [(480, 60), (60, 50)])
def test_a_pose_has_the_support_of_corners_and_patches(columns_shown: int, inliers: int) -> None:
    """A keyframe most of which shows other texture supports the pose with few patches."""
    shown = np.where(np.arange(480) < columns_shown, texture(1), texture(2))
    pose = likeliest(texture(1), shown, recognised(np.zeros(6), 60))
    assert pose is not None and pose.inliers <= inliers and (pose.inliers == inliers) == (columns_shown == 480)


def test_a_pose_that_no_patch_supports_is_none() -> None:
    assert likeliest(texture(1), np.zeros((120, 480), np.uint8), recognised(np.zeros(6), 60)) is None
    assert likeliest(texture(1), texture(1)) is None


def test_of_two_poses_that_explain_the_patches_equally_well_none_is_taken() -> None:
    one, other = recognised(np.zeros(6), 60), recognised(TURNED, 60)
    for alone in (one, other):
        assert likeliest(alike(), alike(), alone, alone) is not None
    assert likeliest(alike(), alike(), one, other) is None
