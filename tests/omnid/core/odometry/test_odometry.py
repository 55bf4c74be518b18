"""Short rendered runs: accuracy, also through a turn; darkness, relocalisation, refused poses."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from numpy.typing import NDArray

from calib import se3
from omnid.core.odometry.estimates import OdometryEstimate, OdometryLimits
from omnid.core.odometry.odometry import VisualOdometry
from omnid.core.odometry.stereo_frame import StereoFrame
from omnid.core.odometry.tracking import KltSettings
from omnid.core.places.recognition import Relocaliser
from omnid.core.types.pixel_times import SYNCHRONISED, PixelTimes
from omnid.core.types.stereo_model import StereoModel
from omnid.tracking_state import TrackingState
from tests.omnid.core.scenery import RenderedCameras, motion_errors
from tests.simulation import corridor
from tests.simulation.paths import planar_poses

Array = NDArray[np.float64]

PERIOD_S = 0.1
PATH = planar_poses(
    np.array([[0.05 * k, 0] for k in range(5)] + [[0.2, 0.05 * k] for k in range(5)]), np.repeat([0.0, np.pi / 2], 5)
)  # a turn on the spot between two pairs, in the middle


def truth(k: int) -> Array:
    """Return T_odom_rect at pair k."""
    return np.asarray(se3.inverse(PATH[0]) @ PATH[k])


@pytest.fixture(scope="module")
def frames(cameras: RenderedCameras) -> list[StereoFrame]:
    return [cameras.frame(k, T) for k, T in enumerate(PATH)]


def run(odometry: VisualOdometry, frames: list[StereoFrame], first: bool = True) -> list[OdometryEstimate]:
    """Return the estimates of frames that are PERIOD_S apart."""
    return [odometry.process(frame, 0.0 if first and k == 0 else PERIOD_S) for k, frame in enumerate(frames)]


def visual_odometry(model: StereoModel, limits: OdometryLimits) -> VisualOdometry:
    """Return the odometry as the stage builds it."""
    return VisualOdometry(model, KltSettings(), limits, Relocaliser(model))


@pytest.fixture
def odometry(cameras: RenderedCameras) -> VisualOdometry:
    return visual_odometry(cameras.model, OdometryLimits())


@pytest.mark.parametrize("late", ["lower", "upper"])
def test_a_pose_that_one_camera_contradicts_is_refused(
    odometry: VisualOdometry, frames: list[StereoFrame], late: str
) -> None:
    """The landmarks agree in the lower panorama, and the upper one shows another instant."""
    before, frame = frames[2:4]
    other = replace(frame, lower=before.lower) if late == "lower" else replace(frame, upper=before.upper)
    estimates = run(odometry, [*frames[:3], other, frames[4]])
    assert [e.state for e in estimates[:3]] == [TrackingState.TRACKING] * 3
    assert estimates[3].state is TrackingState.DEGRADED and estimates[3].covariance[0, 0] > 0.04**2
    assert motion_errors(estimates[4].T_odom_rect, truth(4))[0] < 0.01


def test_the_path_through_a_right_angle_and_its_error_are_estimated(
    odometry: VisualOdometry, frames: list[StereoFrame]
) -> None:
    for k, estimate in enumerate(run(odometry, frames)):
        distance, angle = motion_errors(estimate.T_odom_rect, truth(k))
        assert distance < 4e-3 and angle < 2e-3, k
        assert (estimate.state, estimate.resets) == (TrackingState.TRACKING, 0)
        assert estimate.tracked >= estimate.inliers >= 50
        if k == 0:
            continue
        np.testing.assert_allclose(estimate.covariance, estimate.covariance.T, atol=1e-12)
        error = se3.log(se3.inverse(estimate.T_odom_rect) @ truth(k))
        assert error @ np.linalg.solve(estimate.covariance, error) < 30  # a chi-square of six degrees of freedom
        assert np.sqrt(np.diag(estimate.covariance)).max() < 5e-3


@pytest.mark.parametrize("first", [0, 1])
def test_cameras_whose_stamps_differ_in_some_pairs_only_are_tracked(
    odometry: VisualOdometry, frames: list[StereoFrame], first: int
) -> None:
    """As at the start, where the scatter of the stamps is not known: the first map may be made again at any pair."""
    times = [PixelTimes(skew_s=2e-3), SYNCHRONISED]
    seen = [replace(frame, times=times[(first + k) % 2]) for k, frame in enumerate(frames)]
    for k, estimate in enumerate(run(odometry, seen)):
        assert motion_errors(estimate.T_odom_rect, truth(k))[0] < 0.02, k
        assert (estimate.state, estimate.resets) == (TrackingState.TRACKING, 0)


def test_few_landmarks_all_around_support_each_pose(cameras: RenderedCameras) -> None:
    """As in a plain corridor: keyframes add a few each, and the one that anchors most of them stays in a full map."""
    path = planar_poses(np.array([[0.1 * k, 0] for k in range(14)]), np.zeros(14))
    odometry = visual_odometry(cameras.model, OdometryLimits(features=40))
    for estimate, T in zip(run(odometry, [cameras.frame(k, T) for k, T in enumerate(path)]), path, strict=True):
        assert motion_errors(estimate.T_odom_rect, se3.inverse(path[0]) @ T)[0] < 0.01
        assert estimate.state is TrackingState.TRACKING and 20 <= estimate.inliers < 50


def test_a_base_at_rest_does_not_wander_and_one_that_creeps_is_followed(
    odometry: VisualOdometry, cameras: RenderedCameras
) -> None:
    """Eight frames at rest, then 2 mm/s: noise is no step, and no more is missing than what may be noise."""
    path = planar_poses(np.array([[2e-4 * max(0, k - 7), 0] for k in range(24)]), np.zeros(24))
    estimates = run(odometry, [cameras.frame(k, T) for k, T in enumerate(path)])
    assert all(np.array_equal(estimate.T_odom_rect, np.eye(4)) for estimate in estimates[:8])
    for estimate, T in zip(estimates, path, strict=True):
        assert motion_errors(estimate.T_odom_rect, se3.inverse(path[0]) @ T)[0] < 1.5e-3
        assert estimate.state is TrackingState.TRACKING


def test_one_dark_pair_is_degraded_and_the_pose_is_predicted(
    odometry: VisualOdometry, frames: list[StereoFrame], cameras: RenderedCameras
) -> None:
    before = run(odometry, frames[:4])[-1]
    dark = odometry.process(cameras.darkness(100), PERIOD_S)
    assert dark.state == TrackingState.DEGRADED and dark.inliers == 0
    assert np.trace(dark.covariance) > 2 * np.trace(before.covariance)
    ahead = (se3.inverse(before.T_odom_rect) @ dark.T_odom_rect)[:3, 3]
    np.testing.assert_allclose(ahead, [0.05, 0, 0], atol=0.015)  # the motion before
    back = run(odometry, [frames[4], frames[5], frames[6]], first=False)
    assert back[0].state == TrackingState.DEGRADED and back[-1].state == TrackingState.TRACKING
    distance, angle = motion_errors(back[-1].T_odom_rect, truth(6))
    assert distance < 4e-3 and angle < 2e-3 and back[-1].resets == 0


def test_a_long_darkness_is_lost_and_ends_with_relocalisation(
    odometry: VisualOdometry, frames: list[StereoFrame], cameras: RenderedCameras
) -> None:
    run(odometry, frames[:4])
    dark = run(odometry, [cameras.darkness(100 + k) for k in range(6)], first=False)
    assert [estimate.state for estimate in dark] == [TrackingState.DEGRADED] * 2 + [TrackingState.LOST] * 4
    assert (np.diff([np.trace(estimate.covariance) for estimate in dark]) > 0).all()
    steps = np.linalg.norm(np.diff([estimate.T_odom_rect[:3, 3] for estimate in dark], axis=0), axis=1)
    assert (np.diff(steps) < 0).all() and steps[-1] < 0.02  # slowing down
    back = run(odometry, frames[3:6], first=False)
    for k, estimate in enumerate(back, 3):
        distance, angle = motion_errors(estimate.T_odom_rect, truth(k))
        assert distance < 0.02 and angle < 0.01, k
    assert (back[-1].state, back[-1].resets) == (TrackingState.TRACKING, 0)


def test_odometry_relocalises_at_a_keyframe_where_tracking_finds_nothing(cameras: RenderedCameras) -> None:
    """A tracker that reaches a pixel far does not find the way back; a keyframe does, and the gap is closed."""
    odometry = VisualOdometry(
        cameras.model, KltSettings(iterations=1, levels=0), OdometryLimits(), Relocaliser(cameras.model)
    )
    run(odometry, [cameras.frame(k, PATH[0]) for k in range(3)])
    run(odometry, [cameras.darkness(100 + k) for k in range(6)], first=False)
    (T_world_rig,) = planar_poses(np.array([[0.3, -0.3]]), np.array([0.45]))
    back = run(odometry, [cameras.frame(200 + k, T_world_rig) for k in range(2)], first=False)
    distance, angle = motion_errors(back[0].T_odom_rect, se3.inverse(PATH[0]) @ T_world_rig)
    assert distance < 2e-3 and angle < 1e-3, "as exact as tracking, by the patches of the local map"
    assert [estimate.state for estimate in back] == [TrackingState.DEGRADED, TrackingState.TRACKING]
    assert back[-1].resets == 0 and np.sqrt(np.diag(back[-1].covariance)).max() < 0.03


def test_odom_does_not_jump_to_a_keyframe_far_from_the_predicted_pose(cameras: RenderedCameras) -> None:
    """Carried in the dark: the place is known, but odom goes on, with a higher reset counter and a larger sigma."""
    path = planar_poses(np.array([[0.25 * k, 0] for k in range(6)]), np.zeros(6))
    odometry = visual_odometry(cameras.model, OdometryLimits(keyframes=2))
    run(odometry, [cameras.frame(k, T) for k, T in enumerate(path)])
    dark = run(odometry, [cameras.darkness(100 + k) for k in range(6)], first=False)
    (T_world_rig,) = planar_poses(np.array([[0.1, -0.1]]), np.array([2.0]))
    there = run(odometry, [cameras.frame(200 + k, T_world_rig) for k in range(3)], first=False)
    poses = [estimate.T_odom_rect for estimate in (dark[-1], *there)]
    assert max(motion_errors(a, b)[0] for a, b in pairwise(poses)) < 0.1
    assert [estimate.resets for estimate in there] == [1, 1, 1]
    assert [estimate.state for estimate in there] == [TrackingState.DEGRADED, *[TrackingState.TRACKING] * 2]
    error = se3.log(se3.inverse(there[0].T_odom_rect) @ se3.inverse(path[0]) @ T_world_rig)
    assert error @ np.linalg.solve(there[0].covariance, error) < 12  # the gap is known, so it is in the covariance


def test_frames_that_match_nothing_are_refused_and_then_restart_the_map(
    frames: list[StereoFrame], cameras: RenderedCameras
) -> None:
    """The robot is carried into another corridor: no pose is accepted there, and then the reset counter rises."""
    limits = OdometryLimits(restart_s=0.75)  # six frames
    odometry = visual_odometry(cameras.model, limits)
    before = run(odometry, frames[:4])[-1]
    elsewhere = replace(cameras, scene=corridor(7))
    there = run(odometry, [elsewhere.frame(50 + k, PATH[k % 4]) for k in range(12)], first=False)
    restarted = 3 + 6 - 2
    assert all(estimate.inliers == 0 and estimate.state != TrackingState.TRACKING for estimate in there[:restarted])
    assert there[3].state == TrackingState.LOST
    assert [estimate.resets for estimate in there[restarted:]] == [1] * (12 - restarted)
    assert all(estimate.state == TrackingState.TRACKING for estimate in there[restarted + 1 :])
    # The robot moves in that corridor as it does in this one; the gap stays in the covariance.
    moved = se3.inverse(there[-2].T_odom_rect) @ there[-1].T_odom_rect
    assert motion_errors(moved, se3.inverse(PATH[2]) @ PATH[3])[0] < 5e-3
    assert np.sqrt(there[-1].covariance[0, 0]) > 0.1 > 10 * np.sqrt(before.covariance[0, 0])


def test_a_pose_refused_for_its_speed_leaves_a_covariance_that_covers_it(cameras: RenderedCameras) -> None:
    """The vehicle may be as fast as the pose says that was refused."""
    odometry = visual_odometry(cameras.model, OdometryLimits(max_speed_mps=2.0))
    poses = planar_poses(np.array([[0.4 * k, 0.0] for k in range(4)]), np.zeros(4))
    found = run(odometry, [cameras.frame(k, T) for k, T in enumerate(poses)])
    for k, estimate in enumerate(found[1:3], 1):
        off_m = float(np.linalg.norm(estimate.T_odom_rect[:3, 3] - 0.4 * k * np.array([1.0, 0, 0])))
        assert estimate.state is TrackingState.DEGRADED and off_m > 0.35, k
        assert off_m < 2 * float(np.sqrt(np.trace(estimate.covariance[:3, :3]) / 3)), k
