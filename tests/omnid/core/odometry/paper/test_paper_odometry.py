"""The paper's ego-motion: its equations, its trackers, and a short rendered run."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from calib import se3
from omnid.core.odometry.corners import corners
from omnid.core.odometry.paper.paper_odometry import UNKNOWN_SPEED_SIGMA, PaperOdometry, turned_track
from omnid.core.odometry.stereo_frame import StereoFrame
from omnid.core.odometry.tracking import KltSettings
from omnid.tracking_state import TrackingState
from tests.omnid.core.scenery import RenderedCameras, motion_errors, texture, turned, wrapped
from tests.simulation.paths import planar_poses

PATH = planar_poses(
    np.array([[0.05 * k, 0] for k in range(4)] + [[0.15, 0.05 * k] for k in range(4)]), np.repeat([0.0, np.pi / 2], 4)
)


def image(panorama: NDArray[np.uint8], seq: int = 0) -> StereoFrame:
    no_disparity = np.full(panorama.shape, np.nan, np.float32)
    return StereoFrame(seq, wrapped(panorama), wrapped(panorama), no_disparity, np.ones(panorama.shape, bool))


@pytest.mark.parametrize("degrees", [0.0, 26.0, -45.0, 94.0, 180.0])
def test_the_improved_tracker_finds_features_through_any_turn(degrees: float) -> None:
    columns = round(degrees / 360 * 480)
    before, after = image(texture(1)), image(turned(texture(1), columns))
    features = corners(before.lower, before.usable, 300)
    there, found = turned_track(before, after, features, KltSettings())
    assert found.mean() > 0.5
    error = (there[found, 0] - features[found, 0] - columns + 240) % 480 - 240
    assert np.mean(np.abs(error) < 0.5) > 0.95


@pytest.fixture(scope="module")
def frames(cameras: RenderedCameras) -> list[StereoFrame]:
    return [cameras.frame(k, T) for k, T in enumerate(PATH)]


def test_a_path_through_a_right_angle_is_estimated(cameras: RenderedCameras, frames: list[StereoFrame]) -> None:
    odometry = PaperOdometry(cameras.model, KltSettings())
    for k, frame in enumerate(frames):
        estimate = odometry.process(frame, 0.1 if k else 0.0)
        distance, angle = motion_errors(estimate.T_odom_rect, se3.inverse(PATH[0]) @ PATH[k])
        assert distance < 0.025 and angle < 0.01, k
        assert (estimate.state, estimate.resets) == (TrackingState.TRACKING, 0)
    sigmas = np.sqrt(np.diag(estimate.covariance))
    assert sigmas.min() > 5e-4 and sigmas.max() < 0.02


@pytest.mark.parametrize("tracker", ["improved", "klt"])
def test_the_pose_is_lost_in_darkness_and_kept(
    cameras: RenderedCameras, frames: list[StereoFrame], tracker: str
) -> None:
    odometry = PaperOdometry(cameras.model, KltSettings(), tracker)
    odometry.process(frames[0], 0.0)
    before = odometry.process(frames[1], 0.1)
    into, out = odometry.process(cameras.darkness(9), 0.1), odometry.process(frames[1], 0.1)
    for estimate in (into, out):
        assert estimate.state == TrackingState.LOST
        np.testing.assert_array_equal(estimate.T_odom_rect, before.T_odom_rect)
    assert np.trace(out.covariance) > np.trace(into.covariance) > np.trace(before.covariance)
    # The motion in the gap is not known: odom goes on from another place, within its sigma.
    again = odometry.process(frames[2], 0.1)
    assert (again.state, again.resets) == (TrackingState.DEGRADED, 1)
    np.testing.assert_allclose(np.sqrt(again.covariance[0, 0]), UNKNOWN_SPEED_SIGMA * 0.2, rtol=0.05)
    after = odometry.process(frames[3], 0.1)
    assert (after.state, after.resets) == (TrackingState.TRACKING, 1)
    moved = se3.inverse(out.T_odom_rect) @ again.T_odom_rect
    assert motion_errors(moved, se3.inverse(PATH[1]) @ PATH[2])[0] < 0.02
