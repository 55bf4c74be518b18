"""Frames that show nothing, while wheels and gyro measure the motion: the pose goes on, within limits."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from calib import se3
from drivers.motion import GyroSample, MotionSample, WheelSample
from omnid.core.odometry.estimates import OdometryEstimate, OdometryLimits
from omnid.core.odometry.motion_filter import MotionFilter
from omnid.core.odometry.odometry import VisualOdometry
from omnid.core.odometry.stereo_frame import StereoFrame
from omnid.core.odometry.tracking import KltSettings
from omnid.core.places.recognition import Relocaliser
from omnid.tracking_state import TrackingState
from tests.omnid.core.scenery import RenderedCameras, motion_errors
from tests.simulation import corridor
from tests.simulation.paths import planar_poses

Array = NDArray[np.float64]

PERIOD_S = 0.1
PATH = planar_poses(np.array([[0.05 * k, 0] for k in range(24)]), np.zeros(24))
AHEAD, AT_REST, GYRO = WheelSample(0, 0.5, 0.0), WheelSample(0, 0.0, 0.0), GyroSample(0, 0.0, 0.0, 0.0)
SOON = OdometryLimits(restart_s=0.45)  # few frames: each one of another place costs a search through all turns
DEGRADED, LOST, TRACKING = TrackingState.DEGRADED, TrackingState.LOST, TrackingState.TRACKING


class Robot:
    """The odometry with the samples of wheels and gyro, from one frame to the next."""

    def __init__(self, cameras: RenderedCameras, limits: OdometryLimits, frames: int = 4) -> None:
        """It has seen so many first frames."""
        self._motion, self._now_s = MotionFilter(), 0.0
        relocaliser = Relocaliser(cameras.model)
        self._odometry = VisualOdometry(cameras.model, KltSettings(), limits, relocaliser, motion=self._motion)
        for k in range(frames):
            self.see(cameras.frame(k, PATH[k]), AHEAD, PERIOD_S if k else 0.0)

    def see(self, frame: StereoFrame, sample: MotionSample | None, dt_s: float = PERIOD_S) -> OdometryEstimate:
        """Return the estimate at a frame; sample: of a steady motion since the frame before, None: nothing measured."""
        before_s, self._now_s = self._now_s, self._now_s + dt_s
        if sample is not None:
            times_s = (1.0 + before_s, 1.0 + before_s + dt_s / 2, 1.0 + self._now_s)
            self._motion.sensors.add([replace(sample, stamp_ns=round(1e9 * time_s)) for time_s in times_s])
        seconds = self._motion.sensors.seconds
        interval_s = seconds(round(1e9 * (1.0 + before_s))), seconds(round(1e9 * (1.0 + self._now_s)))
        # Of an interval that nothing measures there are no samples, however long those before it hold.
        known = replace(frame, interval_s=interval_s if sample is not None and dt_s else None)
        return self._odometry.process(known, dt_s)

    def dark(self, cameras: RenderedCameras, steps: int, sample: MotionSample | None = AHEAD) -> list[OdometryEstimate]:
        return [self.see(cameras.darkness(100 + k), sample) for k in range(steps)]


def along(k: int) -> Array:
    return np.asarray(se3.inverse(PATH[0]) @ PATH[k])


def test_wheels_carry_the_pose_through_the_dark(cameras: RenderedCameras) -> None:
    robot = Robot(cameras, OdometryLimits())
    found = robot.dark(cameras, 12)
    assert {estimate.state for estimate in found} == {DEGRADED}
    assert motion_errors(found[-1].T_odom_rect, along(15))[0] < 5e-3
    np.testing.assert_allclose(found[-1].velocity[0], 0.5, atol=0.02)
    sigma_m = np.sqrt([estimate.covariance[0, 0] for estimate in found])
    # Errors that all steps share add up: sigma grows with the number of steps, and not with its root.
    growth_m = sigma_m[11] / sigma_m[2]
    assert (np.diff(sigma_m) > 0).all() and 2.5 < growth_m < 4.5 and sigma_m[-1] < 0.02
    light = robot.see(cameras.frame(50, PATH[16]), AHEAD)
    assert light.state == DEGRADED and light.resets == 0 and light.step is None
    assert motion_errors(light.T_odom_rect, along(16))[0] < 5e-3
    assert robot.see(cameras.frame(51, PATH[17]), AHEAD).state == TRACKING


@pytest.mark.hazard("H14")
@pytest.mark.parametrize("limits", [OdometryLimits(bridge_s=0.55), OdometryLimits(bridge_sigma_m=0.005)])
def test_the_pose_is_lost_after_the_limit_of_time_or_uncertainty(
    cameras: RenderedCameras, limits: OdometryLimits
) -> None:
    found = Robot(cameras, limits).dark(cameras, 8)
    states = [estimate.state for estimate in found]
    assert states[:3] == [DEGRADED] * 3 and states[-2:] == [LOST] * 2 and states == sorted(states)
    assert np.sqrt(found[-1].covariance[0, 0]) > 0.1


def test_without_wheels_or_with_a_gyro_alone_darkness_is_lost(cameras: RenderedCameras) -> None:
    for sample in (None, GYRO):
        # The samples of the wheels hold for a while after the last one.
        found = Robot(cameras, OdometryLimits()).dark(cameras, 6, sample)
        assert [estimate.state for estimate in found][-2:] == [LOST, LOST]


def test_a_base_that_begins_in_the_dark_is_degraded_by_its_wheels_and_lost_without_them(
    cameras: RenderedCameras,
) -> None:
    for sample, state in ((AT_REST, DEGRADED), (None, LOST)):
        robot = Robot(cameras, OdometryLimits(), frames=0)
        robot.see(cameras.darkness(0), None, 0.0)
        assert {estimate.state for estimate in robot.dark(cameras, 4, sample)} == {state}


def test_another_view_after_the_dark_starts_a_new_map_and_odom_goes_on(cameras: RenderedCameras) -> None:
    """It was driven around a corner in the dark: nothing is known there, but the wheels know the way."""
    robot = Robot(cameras, OdometryLimits())
    robot.dark(cameras, 6)
    elsewhere = replace(cameras, scene=corridor(7))
    there = [robot.see(elsewhere.frame(200 + k, PATH[10 + k]), AHEAD) for k in range(12)]
    assert there[-1].state == TRACKING and there[-1].resets == 0
    assert LOST not in {estimate.state for estimate in there}
    assert motion_errors(there[-1].T_odom_rect, along(21))[0] < 0.02
    assert 0.002 < np.sqrt(there[-1].covariance[0, 0]) < 0.05


def elsewhere(robot: Robot, cameras: RenderedCameras, sample: MotionSample) -> list[OdometryEstimate]:
    """Return the estimates at frames of another place, until a new map was started and followed."""
    there = replace(cameras, scene=corridor(7))
    return [robot.see(there.frame(200 + k, PATH[10]), sample) for k in range(6)]


def test_a_base_that_is_carried_away_while_its_wheels_rest_begins_again(cameras: RenderedCameras) -> None:
    """The wheels say that the map is in view, and the images that it is not: the way is not known."""
    robot = Robot(cameras, SOON)
    robot.dark(cameras, 6, AT_REST)
    there = elsewhere(robot, cameras, AT_REST)
    assert [(one.state, one.resets) for one in there[-4:]] == [(DEGRADED, 0), (DEGRADED, 1), *[(TRACKING, 1)] * 2]
    assert np.sqrt(there[-1].covariance[0, 0]) > 0.5
    # In its own place it goes on as before.
    robot = Robot(cameras, SOON)
    robot.dark(cameras, 6, AT_REST)
    back = [robot.see(cameras.frame(60 + k, PATH[3]), AT_REST) for k in range(2)]
    assert (back[-1].state, back[-1].resets) == (TRACKING, 0) and np.sqrt(back[-1].covariance[0, 0]) < 5e-3


def test_a_part_of_the_way_that_nothing_measured_is_not_forgotten(cameras: RenderedCameras) -> None:
    robot = Robot(cameras, SOON)
    for sample in (AHEAD, None, AHEAD):
        found = robot.dark(cameras, 5, sample)
    there = elsewhere(robot, cameras, AHEAD)
    assert {one.resets for one in found} == {0} and {one.state for one in found} == {LOST}
    assert [(one.state, one.resets) for one in there[-4:]] == [(LOST, 0), (DEGRADED, 1), *[(TRACKING, 1)] * 2]
    assert np.sqrt(there[-1].covariance[0, 0]) > 0.1
