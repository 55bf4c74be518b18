"""The control law on the stamps of a log: the same limits and safety rules as on the robot, and the same every time."""

from __future__ import annotations

import math
from itertools import pairwise
from typing import Any

import numpy as np
import pytest

from calib import se3
from drivers.motor import VelocityCommand
from omnid.core.control.control_law import ControllerSettings, ReplaySetpoint
from omnid.core.control.heading_controller import HeadingLimits, VelocityLimits
from omnid.core.control.safety_rules import Deadlines
from omnid.messages import OdometryUpdate
from omnid.stages.lockstep_drive import LockstepDrive, controller_pose
from omnid.tracking_state import TrackingState

PERIOD_S = 0.05
POSE_S = 0.1  # between two poses
LIMITS = VelocityLimits(velocity_mps=0.4, acceleration_mps2=0.5, deceleration_mps2=1.0, yaw_rate_radps=0.8)


def settings(velocity_mps: float = 0.3, heading_deg: float = 0.0) -> ControllerSettings:
    return ControllerSettings(
        Deadlines(), LIMITS, HeadingLimits(acceleration_mps2=10.0), ReplaySetpoint(velocity_mps, heading_deg)
    )


def odometry(
    at_s: float, state: TrackingState = TrackingState.TRACKING, *, heading_rad: float = 0.0, rate_radps: float = 0.0
) -> OdometryUpdate:
    T_odom_rig = se3.exp(np.array([0.0, 0.0, 0.0, 0.0, 0.0, heading_rad]))
    velocity = np.array([0.0, 0.0, 0.0, 0.0, 0.0, rate_radps])
    depth: Any = None
    return OdometryUpdate(
        0, 10**12 + round(at_s * 1e9), T_odom_rig, np.eye(6), velocity, 1e-4 * np.eye(6), state, 0, 99, 99, depth
    )


def driven(drive: LockstepDrive, count: int, start_s: float = 0.0, **kwargs: Any) -> list[VelocityCommand]:
    """Return the commands for poses every 0.1 s."""
    return [drive.process(odometry(start_s + POSE_S * k, **kwargs)) for k in range(count)]


def test_starts_from_a_stop_and_keeps_the_limits() -> None:
    speeds = [command.velocity_mps for command in driven(LockstepDrive(settings(3.0), PERIOD_S, np.eye(4)), 20)]
    assert speeds[0] == 0.0 and speeds[-1] == LIMITS.velocity_mps
    assert all(b - a <= LIMITS.acceleration_mps2 * POSE_S + 1e-9 for a, b in pairwise(speeds))


def test_slows_down_where_the_pose_is_lost_and_drives_on_once_it_is_found() -> None:
    drive = LockstepDrive(settings(), PERIOD_S, np.eye(4))
    driven(drive, 20)
    lost = [command.velocity_mps for command in driven(drive, 5, 2.0, state=TrackingState.LOST)]
    assert lost == pytest.approx([0.25, 0.15, 0.05, 0.0, 0.0], abs=1e-6)
    assert 0.0 < drive.process(odometry(2.5)).velocity_mps <= LIMITS.acceleration_mps2 * POSE_S + 1e-9


@pytest.mark.parametrize(("gap_s", "speed_mps"), [(0.5, 0.3), (0.7, 0.175), (3.0, 0.025), (1e6, 0.025)])
def test_a_gap_in_the_log_stops_the_wheels(gap_s: float, speed_mps: float) -> None:
    """The pose is stale after 0.5 s, then the wheels slow down by 1 m/s^2; after the gap they start again."""
    drive = LockstepDrive(settings(), PERIOD_S, np.eye(4))
    driven(drive, 20)
    command = drive.process(odometry(1.9 + gap_s))
    assert command.velocity_mps == pytest.approx(speed_mps, abs=1e-6)


def test_steers_the_base_and_not_the_rig() -> None:
    """A rig that looks backwards on the base: where the rig has turned left about z, so has the base."""
    T_base_rig = se3.exp(np.array([0, 0, 0, 0, 0, np.pi]))
    drive = LockstepDrive(settings(heading_deg=math.degrees(0.5)), PERIOD_S, T_base_rig)
    assert driven(drive, 3, heading_rad=0.5)[-1].yaw_rate_radps == pytest.approx(0, abs=1e-9)


@pytest.mark.parametrize("odd", [{"heading_rad": math.nan}, {"rate_radps": math.nan}])
def test_a_pose_that_is_not_finite_is_lost(odd: dict[str, float]) -> None:
    assert controller_pose(odometry(0.0), np.eye(4)).state == TrackingState.TRACKING
    assert controller_pose(odometry(0.0, **odd), np.eye(4)).state == TrackingState.LOST


def test_the_controllers_pose_is_that_of_the_base() -> None:
    T_base_rig = se3.transform(se3.rotation_exp([0.0, 0.0, 0.5]), [0.1, 0.0, 0.3])
    pose = controller_pose(odometry(0.0, heading_rad=0.2, rate_radps=0.3), T_base_rig)
    assert pose.heading_rad == pytest.approx(0.2) and pose.yaw_rate_radps == pytest.approx(0.3)
