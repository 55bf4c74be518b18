"""Rates in messages of wheels and IMUs, as rosbags writes them."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest

from drivers.errors import FrameDecodeError
from drivers.logs.joint_wheels import JOINT_STATE, JointWheels
from drivers.logs.ros_motion import IMU, MOST_JOINTS, ODOMETRY, MotionReading, parse_motion
from drivers.motion import GyroSample, WheelSample
from tests.drivers.logs.mcap_logs import STORE, TYPES, header

VECTOR, QUATERNION, ZEROS = TYPES["geometry_msgs/msg/Vector3"], TYPES["geometry_msgs/msg/Quaternion"], np.zeros(36)
WHEELS = JointWheels("left", "right", 0.1, 0.4)


def odometry(velocity_mps: float, yaw_rate_radps: float) -> bytes:
    pose = TYPES["geometry_msgs/msg/Pose"](
        TYPES["geometry_msgs/msg/Point"](9.0, 9.0, 9.0), QUATERNION(9.0, 9.0, 9.0, 9.0)
    )
    twist = TYPES["geometry_msgs/msg/Twist"](VECTOR(velocity_mps, 9.0, 9.0), VECTOR(9.0, 9.0, yaw_rate_radps))
    parts = (
        TYPES["geometry_msgs/msg/PoseWithCovariance"](pose, ZEROS),
        TYPES["geometry_msgs/msg/TwistWithCovariance"](twist, ZEROS),
    )
    return serialised(TYPES[ODOMETRY](header(5, "odom"), "base_link", *parts), ODOMETRY)


def imu(rates: tuple[float, float, float], frame: str = "imu", covariance: float = 0.0) -> bytes:
    nine = np.zeros(9)
    nine[0] = covariance
    message = TYPES[IMU](
        header(5, frame),
        QUATERNION(9.0, 9.0, 9.0, 9.0),
        np.zeros(9),
        VECTOR(*rates),
        nine,
        VECTOR(9.0, 9.0, 9.0),
        np.zeros(9),
    )
    return serialised(message, IMU)


def joints(names: list[str], velocities: list[float]) -> bytes:
    return serialised(
        TYPES[JOINT_STATE](header(5), names, np.full(len(names), 9.0), np.array(velocities), np.zeros(0)), JOINT_STATE
    )


def serialised(message: Any, kind: str) -> bytes:
    return bytes(STORE.serialize_cdr(message, kind))


def read(kind: str, data: bytes) -> MotionReading:
    return parse_motion(kind, memoryview(data), joints=WHEELS)


def test_the_rates_are_those_of_the_base() -> None:
    assert read(ODOMETRY, odometry(0.3, -0.2)).sample(7) == WheelSample(5, 0.3, -0.2)
    assert read(IMU, imu((0.1, 0.2, 0.3))).sample(7) == GyroSample(5, 0.1, 0.2, 0.3)
    assert read(IMU, imu((0.1, 0.2, 0.3), "base_link")).sample(7) == GyroSample(5, 0.1, 0.2, 0.3, of_base=True)
    assert read(JOINT_STATE, joints(["arm", "left", "right"], [9.0, 2.0, 4.0])).rates == pytest.approx((0.3, 0.5))
    assert read(JOINT_STATE, joints(["arm"], [9.0])).rates == ()


def test_the_log_time_stands_for_a_missing_stamp() -> None:
    assert MotionReading(0, (0.3, 0.1)).sample(7).stamp_ns == 7


def test_wheels_may_not_report_their_turn_and_nothing_is_infinite() -> None:
    assert math.isnan(read(ODOMETRY, odometry(0.3, math.nan)).rates[1])
    for data, kind in (
        (odometry(math.nan, 0.1), ODOMETRY),
        (odometry(0.1, math.inf), ODOMETRY),
        (imu((0, 0, math.nan)), IMU),
    ):
        with pytest.raises(FrameDecodeError, match="not finite"):
            read(kind, data)


def test_an_imu_without_angular_velocity_is_refused() -> None:
    with pytest.raises(FrameDecodeError, match="covariance begins with -1"):
        read(IMU, imu((0.0, 0.0, 0.0), covariance=-1.0))


@pytest.mark.parametrize(("kind", "data"), [(ODOMETRY, odometry(1.0, 1.0)), (IMU, imu((1.0, 1.0, 1.0)))])
def test_truncated_messages_are_refused(kind: str, data: bytes) -> None:
    for size in range(0, 140, 9):
        with pytest.raises(FrameDecodeError):
            read(kind, data[:size])


def test_the_number_of_joints_is_bounded() -> None:
    with pytest.raises(FrameDecodeError, match=f"more than {MOST_JOINTS}"):
        read(JOINT_STATE, joints(["a"] * (MOST_JOINTS + 1), [0.0] * (MOST_JOINTS + 1)))
