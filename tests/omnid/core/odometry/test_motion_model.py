"""Frames that show nothing, while wheels and gyro measure the motion: the pose goes on, within limits."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from calib import se3
from omnid.core.odometry.estimates import OdometryEstimate, OdometryLimits
from omnid.core.odometry.motion_sensors import SensedMotion
from omnid.core.odometry.odometry import VisualOdometry
from omnid.core.odometry.stereo_frame import StereoFrame
from omnid.core.odometry.tracking import KltSettings
from omnid.core.places.relocalisation import Relocaliser
from omnid.tracking_state import TrackingState
from tests.omnid.core.scenery import RenderedCameras, motion_errors
from tests.simulation import corridor
from tests.simulation.paths import planar_poses

Array = NDArray[np.float64]

PERIOD_S = 0.1
PATH = planar_poses(np.array([[0.05 * k, 0] for k in range(24)]), np.zeros(24))
NOISE = np.diag(np.repeat([5e-4, 2e-4], 3) ** 2)
SYSTEMATIC = np.diag([1e-3, 0, 0, 0, 0, 1e-4]) ** 2
AHEAD = SensedMotion(np.array([0.05, 0, 0, 0, 0, 0]), NOISE, SYSTEMATIC, is_complete=True)
STANDS = replace(AHEAD, twist=np.zeros(6), systematic=np.zeros((6, 6)))
SOON = OdometryLimits(restart_s=0.25)  # four frames: each one of another place costs a search through all turns
DEGRADED, LOST, TRACKING = TrackingState.DEGRADED, TrackingState.LOST, TrackingState.TRACKING


def started(cameras: RenderedCameras, limits: OdometryLimits) -> VisualOdometry:
    """Return an odometry that has seen the first four frames."""
    odometry = VisualOdometry(cameras.model, KltSettings(), limits, Relocaliser(cameras.model))
    for k in range(4):
        odometry.process(sensed(cameras.frame(k, PATH[k]), AHEAD), PERIOD_S if k else 0.0)
    return odometry


def sensed(frame: StereoFrame, motion: SensedMotion | None) -> StereoFrame:
    return replace(frame, sensed=motion)


def dark(
    odometry: VisualOdometry, cameras: RenderedCameras, steps: int, motion: SensedMotion | None = AHEAD
) -> list[OdometryEstimate]:
    return [odometry.process(sensed(cameras.darkness(100 + k), motion), PERIOD_S) for k in range(steps)]


def along(k: int) -> Array:
    return np.asarray(se3.inverse(PATH[0]) @ PATH[k])


def test_wheels_carry_the_pose_through_the_dark(cameras: RenderedCameras) -> None:
    odometry = started(cameras, OdometryLimits())
    found = dark(odometry, cameras, 12)
    assert {estimate.state for estimate in found} == {DEGRADED}
    assert motion_errors(found[-1].T_odom_rect, along(15))[0] < 5e-3
    np.testing.assert_allclose(found[-1].velocity[0], 0.5, atol=0.02)
    sigma = np.sqrt([estimate.covariance[0, 0] for estimate in found])
    assert (np.diff(sigma) > 0).all()
    # Errors that all steps share add up: a millimetre a step, and not its root.
    assert 0.012 < sigma[-1] < 0.014
    light = odometry.process(sensed(cameras.frame(50, PATH[16]), AHEAD), PERIOD_S)
    assert light.state == DEGRADED and light.resets == 0 and light.step is None
    assert motion_errors(light.T_odom_rect, along(16))[0] < 5e-3
    assert odometry.process(sensed(cameras.frame(51, PATH[17]), AHEAD), PERIOD_S).state == TRACKING


@pytest.mark.hazard("H14")
@pytest.mark.parametrize("limits", [OdometryLimits(bridge_s=0.55), OdometryLimits(bridge_sigma_m=0.0055)])
def test_the_pose_is_lost_after_the_limit_of_time_or_uncertainty(
    cameras: RenderedCameras, limits: OdometryLimits
) -> None:
    found = dark(started(cameras, limits), cameras, 8)
    assert [estimate.state for estimate in found] == [DEGRADED] * 5 + [LOST] * 3
    assert np.sqrt(found[-1].covariance[0, 0]) > 0.1


def test_without_wheels_or_with_a_gyro_alone_darkness_is_lost(cameras: RenderedCameras) -> None:
    for motion in (None, replace(AHEAD, is_complete=False)):
        found = dark(started(cameras, OdometryLimits()), cameras, 4, motion)
        assert [estimate.state for estimate in found] == [DEGRADED, DEGRADED, LOST, LOST]


def test_another_view_after_the_dark_starts_a_new_map_and_odom_goes_on(cameras: RenderedCameras) -> None:
    """It was driven around a corner in the dark: nothing is known there, but the wheels know the way."""
    odometry = started(cameras, OdometryLimits())
    dark(odometry, cameras, 6)
    elsewhere = replace(cameras, scene=corridor(7))
    there = [odometry.process(sensed(elsewhere.frame(200 + k, PATH[10 + k]), AHEAD), PERIOD_S) for k in range(12)]
    assert there[-1].state == TRACKING and there[-1].resets == 0
    assert LOST not in {estimate.state for estimate in there}
    assert motion_errors(there[-1].T_odom_rect, along(21))[0] < 0.02
    assert 0.015 < np.sqrt(there[-1].covariance[0, 0]) < 0.05


def elsewhere(odometry: VisualOdometry, cameras: RenderedCameras, motion: SensedMotion) -> list[OdometryEstimate]:
    """Return the estimates at frames of another place, until a new map was started and followed."""
    there = replace(cameras, scene=corridor(7))
    steps = range(6)
    return [odometry.process(sensed(there.frame(200 + k, PATH[10]), motion), PERIOD_S) for k in steps]


def test_a_base_that_is_carried_away_while_its_wheels_stand_begins_again(cameras: RenderedCameras) -> None:
    """The wheels say that the map is in view, and the images that it is not: the way is not known."""
    odometry = started(cameras, SOON)
    dark(odometry, cameras, 6, STANDS)
    there = elsewhere(odometry, cameras, STANDS)
    assert [(one.state, one.resets) for one in there[-4:]] == [(DEGRADED, 0), (DEGRADED, 1), *[(TRACKING, 1)] * 2]
    assert np.sqrt(there[-1].covariance[0, 0]) > 0.5
    # In its own place it goes on as before.
    odometry = started(cameras, SOON)
    dark(odometry, cameras, 6, STANDS)
    back = [odometry.process(sensed(cameras.frame(60 + k, PATH[3]), STANDS), PERIOD_S) for k in range(2)]
    assert (back[-1].state, back[-1].resets) == (TRACKING, 0) and np.sqrt(back[-1].covariance[0, 0]) < 5e-3


def test_a_part_of_the_way_that_nothing_measured_is_not_forgotten(cameras: RenderedCameras) -> None:
    odometry = started(cameras, SOON)
    for motion in (AHEAD, None, AHEAD):
        found = dark(odometry, cameras, 5, motion)
    there = elsewhere(odometry, cameras, AHEAD)
    assert {one.resets for one in found} == {0}
    assert [(one.state, one.resets) for one in there[-4:]] == [(DEGRADED, 0), (DEGRADED, 1), *[(TRACKING, 1)] * 2]
    assert np.sqrt(there[-1].covariance[0, 0]) > 0.1


def test_a_way_without_a_map_that_nothing_measured_is_not_forgotten(cameras: RenderedCameras) -> None:
    """The upper lens is fogged: there is texture that matches nothing, and no depth for a new map."""
    odometry = started(cameras, SOON)
    there, black = replace(cameras, scene=corridor(7)), cameras.darkness(0)
    found = [
        odometry.process(
            replace(there.frame(100 + k, PATH[10]), upper=black.upper, disparities=black.disparities, sensed=motion),
            PERIOD_S,
        )
        for k, motion in enumerate([AHEAD] * 5 + [None] * 4)
    ]
    assert [found[-5].state, found[-1].state] == [DEGRADED, LOST]
    begun = odometry.process(sensed(there.frame(120, PATH[10]), AHEAD), PERIOD_S)
    assert (begun.state, begun.resets) == (DEGRADED, 1)
    assert np.sqrt(begun.covariance[0, 0]) > 0.1
