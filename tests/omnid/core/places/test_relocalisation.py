"""A remembered place is known again from close by, and no other is taken for it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from calib import se3
from omnid.core.odometry.landmarks import Keyframe
from omnid.core.odometry.stereo_frame import StereoFrame
from omnid.core.places.relocalisation import Relocaliser
from tests.omnid.core.scenery import Eyes, motion_errors
from tests.simulation import corridor
from tests.simulation.paths import planar_poses

T_ODOM_KEYFRAME = se3.exp([3.0, 1.0, 0, 0, 0, 2.0])
PLACES = planar_poses(np.array([[0.0, 0], [0.25, 0.17]]), np.array([0.0, 0.7]))


@pytest.fixture(scope="module")
def keyframe(cameras: Eyes) -> StereoFrame:
    return cameras.frame(1, PLACES[0])


@pytest.fixture(scope="module")
def nearby(cameras: Eyes) -> StereoFrame:
    """0.3 m away and turned by 40 degrees."""
    return cameras.frame(2, PLACES[1])


def _remember(places: Relocaliser, frame: StereoFrame, T_odom_rect: NDArray[np.float64]) -> None:
    places.remember(frame, Keyframe(frame.seq, frame.lower, T_odom_rect, np.diag([1e-6] * 6)))


def test_the_pose_beside_a_keyframe_is_found(cameras: Eyes, keyframe: StereoFrame, nearby: StereoFrame) -> None:
    places = Relocaliser(cameras.model)
    _remember(places, keyframe, T_ODOM_KEYFRAME)
    fit = places.locate(nearby)
    assert fit is not None and fit.inliers >= 12 and fit.inliers <= fit.tracked
    truth = T_ODOM_KEYFRAME @ se3.inverse(PLACES[0]) @ PLACES[1]
    distance, angle = motion_errors(fit.T_odom_rect, truth)
    assert distance < 0.02 and angle < 0.01
    deviations = np.sqrt(np.diag(fit.covariance))
    assert distance < 4 * np.linalg.norm(deviations[:3]) and deviations.max() < 0.02


def test_another_place_and_darkness_fit_nowhere(cameras: Eyes, keyframe: StereoFrame) -> None:
    elsewhere = replace(cameras, scene=corridor(7)).frame(3, PLACES[0])
    places = Relocaliser(cameras.model)
    assert places.locate(keyframe) is None
    _remember(places, keyframe, T_ODOM_KEYFRAME)
    fit = places.locate(elsewhere)
    assert fit is None or fit.inliers < 20 or fit.inlier_ratio < 0.4
    assert places.locate(cameras.darkness(4)) is None
    places.forget()
    assert places.locate(keyframe) is None


def test_of_many_keyframes_a_bounded_number_is_kept_the_newest(
    cameras: Eyes, keyframe: StereoFrame, nearby: StereoFrame
) -> None:
    """Blank sights push the good one out; one at the same place replaces the last."""
    places = Relocaliser(cameras.model, places=3)
    _remember(places, keyframe, T_ODOM_KEYFRAME)
    for k in range(2):
        _remember(places, cameras.darkness(10 + k), se3.exp([10.0 + k, 0, 0, 0, 0, 0]))
        _remember(places, cameras.darkness(20 + k), se3.exp([10.1 + k, 0, 0, 0, 0, 0]))
    assert places.locate(nearby) is not None
    _remember(places, cameras.darkness(30), se3.exp([20.0, 0, 0, 0, 0, 0]))
    assert places.locate(nearby) is None
