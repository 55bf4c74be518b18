"""Worlds that repeat: the pose is degraded and its covariance covers all motions, until something tells them apart."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from calib import se3
from drivers.motion import WheelSample
from omnid.core.odometry.estimates import OdometryEstimate, OdometryLimits, PoseEstimate
from omnid.core.odometry.exposure_times import NO_VELOCITY, Exposure
from omnid.core.odometry.motion_filter import MotionFilter
from omnid.core.odometry.motion_hypotheses import OtherMotion
from omnid.core.odometry.odometry import VisualOdometry
from omnid.core.odometry.tracking import KltSettings
from omnid.core.places.recognition import Relocaliser
from omnid.tracking_state import TrackingState
from tests.omnid.core.scenery import RenderedCameras, motion_errors
from tests.simulation import make_rig
from tests.simulation.builders import repeating
from tests.simulation.paths import planar_poses

Array = NDArray[np.float64]

PERIOD_S, PERIOD_M, STEP_M = 0.1, 0.3, 0.28


def driven(cameras: RenderedCameras, poses: Array, speed_mps: float | None = None) -> list[OdometryEstimate]:
    """Return the estimates at poses (N, 4, 4) of the rig, PERIOD_S apart; speed_mps: by wheels."""
    motion = MotionFilter()
    if speed_mps is not None:
        stamps_ns = range(10**9, 10**9 + 10**8 * len(poses), 5 * 10**7)
        motion.sensors.add([WheelSample(stamp_ns, speed_mps, 0.0) for stamp_ns in stamps_ns])
    odometry = VisualOdometry(cameras.model, KltSettings(), OdometryLimits(), Relocaliser(cameras.model), motion=motion)
    found = []
    for k, T in enumerate(poses):
        ends_s = motion.sensors.seconds(10**9 + (k - 1) * 10**8), motion.sensors.seconds(10**9 + k * 10**8)
        frame = replace(cameras.frame(k, T), interval_s=ends_s if k else None)
        found.append(odometry.process(frame, PERIOD_S if k else 0.0))
    return found


@pytest.fixture(scope="module")
def repeated() -> RenderedCameras:
    return RenderedCameras.of(make_rig(size=256), repeating(1, 40.0, PERIOD_M))


def ahead(steps: int, step_m: float) -> Array:
    return planar_poses(np.column_stack([step_m * np.arange(steps + 1), np.zeros(steps + 1)]), np.zeros(steps + 1))


def test_a_world_that_repeats_is_degraded_and_the_covariance_covers_all_motions(repeated: RenderedCameras) -> None:
    """Steps of nearly one period look like small ones back: the pose is wrong, and says so."""
    poses = ahead(6, STEP_M)
    found = driven(repeated, poses)[1:]
    for k, estimate in enumerate(found, 1):
        error = se3.log(se3.inverse(se3.inverse(poses[0]) @ poses[k]) @ estimate.T_odom_rect)[:3]
        assert estimate.state is TrackingState.DEGRADED, k
        assert np.sqrt(error @ np.linalg.solve(estimate.covariance[:3, :3], error) / 3) < 2, k
        assert abs(error[0]) > 0.9 * PERIOD_M, "this world is to mislead"


def test_wheels_decide_between_two_motions(repeated: RenderedCameras) -> None:
    poses = ahead(4, STEP_M)
    for k, estimate in enumerate(driven(repeated, poses, STEP_M / PERIOD_S)):
        assert estimate.state is TrackingState.TRACKING, k
        assert motion_errors(estimate.T_odom_rect, se3.inverse(poses[0]) @ poses[k])[0] < 0.01, k
        assert estimate.covariance[0, 0] < 0.02**2, k


@pytest.mark.parametrize("x_m", [0.1, 0.4])
def test_a_place_is_not_claimed_where_the_world_repeats(
    repeated: RenderedCameras, cameras: RenderedCameras, x_m: float
) -> None:
    """Its corners are those of another period as well."""
    before, there = ahead(4, 0.05), ahead(1, x_m)[1]
    for world in (repeated, cameras):
        odometry = VisualOdometry(world.model, KltSettings(), OdometryLimits(), Relocaliser(world.model))
        for k, T in enumerate(before):
            odometry.process(world.frame(k, T), PERIOD_S if k else 0.0)
        odometry.complete()
        frame = world.frame(100, there)
        found = odometry.relocalise(frame, Exposure(frame.times, NO_VELOCITY, world.model))
        assert (found is None) == (world is repeated)
        assert found is None or motion_errors(found.T_odom_rect, se3.inverse(before[0]) @ there)[0] < 2e-3


def pose(x_m: float) -> PoseEstimate:
    T = se3.exp([x_m, 0, 0, 0, 0, 0])
    return PoseEstimate(T, 1e-6 * np.eye(6), 100, 100, 100, np.arange(100), cost=0.1, in_view=100)


def test_the_other_hypothesis_is_kept_until_steps_without_its_peak_decide() -> None:
    """Its displacements add up, and are forgotten where the published motion goes on as predicted."""
    other = OtherMotion()

    def chosen(*candidates: PoseEstimate, expected_m: float = 0.0) -> float:
        found = other.choose(list(candidates), pose(expected_m).T_odom_rect, PERIOD_S, 0.1)
        return float(found.T_odom_rect[0, 3])

    def sigma_m() -> float:
        return float(np.sqrt(other.covariance(np.eye(4))[0, 0]))

    for k in range(1, 4):
        assert chosen(pose(0.0), pose(0.3)) == 0.0
        assert other.is_open and sigma_m() == pytest.approx(0.3 * k, rel=0.01)
    steps = 0
    while other.is_open:
        chosen(pose(0.0))
        steps += 1
    assert 1 < steps < 6 and sigma_m() < 1e-9
    # It was the other one: the step is not the predicted one, and what was published stays wrong.
    chosen(pose(0.0), pose(0.3))
    chosen(pose(0.3))
    for _ in range(4):
        assert other.is_open and np.linalg.norm(other.velocity) > 2, "it is sought where it may be"
        chosen(pose(0.3), expected_m=0.3)
    assert not other.is_open and sigma_m() == pytest.approx(0.3, rel=0.01)
