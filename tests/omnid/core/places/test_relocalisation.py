"""A kept keyframe is recognised from nearby, and no other place is taken for it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from calib import se3
from omnid.core.odometry.landmarks import Keyframe
from omnid.core.odometry.stereo_frame import StereoFrame
from omnid.core.places.relocalisation import Relocaliser
from tests.omnid.core.scenery import RenderedCameras, motion_errors
from tests.simulation import corridor
from tests.simulation.paths import planar_poses

T_ODOM_KEYFRAME = se3.exp([3.0, 1.0, 0, 0, 0, 2.0])
POSES = planar_poses(np.array([[0.0, 0], [0.25, 0.17]]), np.array([0.0, 0.7]))


@pytest.fixture(scope="module")
def keyframe(cameras: RenderedCameras) -> StereoFrame:
    return cameras.frame(1, POSES[0])


@pytest.fixture(scope="module")
def nearby(cameras: RenderedCameras) -> StereoFrame:
    """0.3 m away and turned by 40 degrees."""
    return cameras.frame(2, POSES[1])


def _add(relocaliser: Relocaliser, frame: StereoFrame, T_odom_rect: NDArray[np.float64]) -> None:
    relocaliser.add(frame, Keyframe(frame.seq, frame.lower, T_odom_rect, np.diag([1e-6] * 6)))


def test_the_pose_beside_a_keyframe_is_found(
    cameras: RenderedCameras, keyframe: StereoFrame, nearby: StereoFrame
) -> None:
    relocaliser = Relocaliser(cameras.model)
    _add(relocaliser, keyframe, T_ODOM_KEYFRAME)
    estimate = relocaliser.locate(nearby)
    assert estimate is not None and estimate.inliers >= 12 and estimate.inliers <= estimate.tracked
    truth = T_ODOM_KEYFRAME @ se3.inverse(POSES[0]) @ POSES[1]
    distance, angle = motion_errors(estimate.T_odom_rect, truth)
    assert distance < 0.02 and angle < 0.01
    sigmas = np.sqrt(np.diag(estimate.covariance))
    assert distance < 4 * np.linalg.norm(sigmas[:3]) and sigmas.max() < 0.02


def test_another_place_and_darkness_are_not_recognised(cameras: RenderedCameras, keyframe: StereoFrame) -> None:
    elsewhere = replace(cameras, scene=corridor(7)).frame(3, POSES[0])
    relocaliser = Relocaliser(cameras.model)
    assert relocaliser.locate(keyframe) is None
    _add(relocaliser, keyframe, T_ODOM_KEYFRAME)
    assert relocaliser.locate(elsewhere) is None
    assert relocaliser.locate(cameras.darkness(4)) is None
    relocaliser.clear()
    assert relocaliser.locate(keyframe) is None


def test_the_newest_keyframes_are_kept_up_to_the_bound(
    cameras: RenderedCameras, keyframe: StereoFrame, nearby: StereoFrame
) -> None:
    """Blank keyframes push the good one out; one near the last keyframe replaces it."""
    relocaliser = Relocaliser(cameras.model, max_keyframes=3)
    _add(relocaliser, keyframe, T_ODOM_KEYFRAME)
    for k in range(2):
        _add(relocaliser, cameras.darkness(10 + k), se3.exp([10.0 + k, 0, 0, 0, 0, 0]))
        _add(relocaliser, cameras.darkness(20 + k), se3.exp([10.1 + k, 0, 0, 0, 0, 0]))
    assert relocaliser.locate(nearby) is not None
    _add(relocaliser, cameras.darkness(30), se3.exp([20.0, 0, 0, 0, 0, 0]))
    assert relocaliser.locate(nearby) is None


def test_of_two_places_that_look_the_same_none_is_chosen(
    cameras: RenderedCameras, keyframe: StereoFrame, nearby: StereoFrame
) -> None:
    relocaliser = Relocaliser(cameras.model)
    _add(relocaliser, keyframe, T_ODOM_KEYFRAME)
    assert relocaliser.locate(nearby) is not None
    _add(relocaliser, replace(keyframe, seq=2), se3.exp([10.0, 0, 0, 0, 0, 0]))
    assert relocaliser.locate(nearby) is None
