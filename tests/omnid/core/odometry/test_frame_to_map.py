"""Steps 2 to 4 of the odometry: a pose needs the tracks from the last frame and the patches of the keyframes."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from calib import se3
from calib.panorama import Cylinder
from omnid.core.odometry.corners import corners
from omnid.core.odometry.estimates import PoseEstimate
from omnid.core.odometry.exposure_times import UNKNOWN_VELOCITY, Exposure, RigVelocity
from omnid.core.odometry.frame_to_map import FrameToMap
from omnid.core.odometry.landmarks import Keyframe
from omnid.core.odometry.local_map import LocalMap
from omnid.core.odometry.stereo_frame import StereoFrame
from omnid.core.odometry.tracking import KltSettings
from omnid.core.types.pixel_times import AT_ONCE, PixelTimes
from omnid.core.types.stereo_model import StereoModel
from tests.omnid.core.scenery import Image, motion_errors, texture, turned, wrapped

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
    local_map.update_tracked(wrapped(lower), np.arange(len(local_map)), local_map.store.table.views[:, :2])
    return local_map


def located(local_map: LocalMap, frame: StereoFrame) -> PoseEstimate | None:
    """The estimate from a guess at the origin."""
    steps = FrameToMap(local_map, MODEL, KltSettings())
    exposure = Exposure.of(AT_ONCE, UNKNOWN_VELOCITY, MODEL)
    coarse = steps.estimate(frame, local_map.track(frame.lower, np.eye(4)), np.eye(4), exposure)
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


def test_the_estimate_carries_the_views_of_its_inliers() -> None:
    estimate = located(map_of(texture(1), texture(1)), stereo_frame(texture(1)))
    assert estimate is not None
    assert len(estimate.landmarks) == len(estimate.views) == len(estimate.pixels)
    disparity = estimate.views[:, 2] - estimate.views[:, 1]
    assert np.isfinite(disparity).mean() > 0.8
    np.testing.assert_allclose(disparity[np.isfinite(disparity)], DISPARITY_PX, atol=0.1)


def test_tracks_that_a_wrong_velocity_made_outliers_are_inliers_again() -> None:
    """The rig stands, but it is believed to pitch between the exposures of its cameras."""
    local_map, frame = map_of(texture(1), texture(1)), replace(stereo_frame(texture(1)), times=PixelTimes(0.03))
    steps, still = FrameToMap(local_map, MODEL, KltSettings()), RigVelocity(np.zeros(6), 1e-4 * np.eye(6))
    pitching = replace(still, twist=np.array([0, 0, 0, 0, 2.0, 0]))
    believed, known = (Exposure(frame.times, motion, MODEL) for motion in (pitching, still))
    tracks = local_map.track(frame.lower, np.eye(4))
    coarse = steps.estimate(frame, tracks, np.eye(4), believed)
    assert coarse is not None and len(coarse.landmarks) < 0.5 * len(tracks.landmarks)
    again = steps.estimate_again(frame, coarse, np.eye(4), known)
    assert len(again.landmarks) > 0.9 * len(tracks.landmarks)
    T_turned = se3.exp([0.01, 0, 0, 0, 0, 0])
    kept = steps.estimate_again(frame, again, T_turned, believed)
    assert kept.landmarks is again.landmarks, "enough were inliers"
    np.testing.assert_allclose(kept.T_curr_odom, se3.inverse(T_turned), atol=1e-12)


def test_no_pose_without_tracks() -> None:
    assert located(map_of(texture(1), texture(1)), stereo_frame(np.zeros((120, 480), np.uint8))) is None


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


def test_a_recognised_pose_that_no_patch_supports_is_none() -> None:
    assert refined(np.zeros((120, 480), np.uint8)) is None


def refined(shown: Image) -> PoseEstimate | None:
    """The pose from one that is a centimetre off; the keyframe shows an image."""
    found = PoseEstimate(se3.exp(RECOGNISED_OFF), 1e-4 * np.eye(6), 80, 80, 60)
    steps = FrameToMap(map_of(texture(1), shown), MODEL, KltSettings())
    return steps.refine_recognised(stereo_frame(texture(1)), found, Exposure.of(AT_ONCE, UNKNOWN_VELOCITY, MODEL))


@pytest.mark.parametrize("columns", [70, -70])
def test_the_best_yaw_is_the_hypothesis_that_keeps_the_landmarks(columns: int) -> None:
    local_map = map_of(texture(1), texture(1))
    frame = stereo_frame(turned(texture(1), columns))
    yaw_rad = columns / 480 * 2 * np.pi
    steps = FrameToMap(local_map, MODEL, KltSettings())
    T = steps.best_yaw(frame, np.eye(4), [0.0, -yaw_rad, yaw_rad, 3.0])
    assert motion_errors(T, se3.exp([0, 0, 0, 0, 0, yaw_rad]))[1] < 1e-9
