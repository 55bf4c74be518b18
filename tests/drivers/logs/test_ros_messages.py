"""Images, wheels and gyros in the bytes of ROS messages, as rosbags writes them, and damaged ones."""

from __future__ import annotations

import math
import random
from typing import Any

import numpy as np
import pytest

from drivers.errors import FrameDecodeError
from drivers.logs.ros_messages import (
    IMAGE_TYPES,
    IMU,
    JOINT_STATE,
    ODOMETRY,
    JointWheels,
    parse_image,
    parse_motion,
)
from drivers.motion import GyroSample, MotionSample, WheelSample
from tests.drivers.logs.mcap_logs import COMPRESSED, IMAGE, LOWER, STORE, TYPES, header, image, image_message

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
    rest = VECTOR(9.0, 9.0, 9.0), np.zeros(9)
    message = TYPES[IMU](header(5, frame), QUATERNION(9.0, 9.0, 9.0, 9.0), np.zeros(9), VECTOR(*rates), nine, *rest)
    return serialised(message, IMU)


def joints(names: list[str], velocities: list[float]) -> bytes:
    message = TYPES[JOINT_STATE](header(5), names, np.full(len(names), 9.0), np.array(velocities), np.zeros(0))
    return serialised(message, JOINT_STATE)


def serialised(message: Any, kind: str) -> bytes:
    return bytes(STORE.serialize_cdr(message, kind))


def read(kind: str, data: bytes) -> MotionSample | None:
    return parse_motion(kind, memoryview(data), joints=WHEELS)


def test_the_rates_are_those_of_the_base() -> None:
    assert read(ODOMETRY, odometry(0.3, -0.2)) == WheelSample(5, 0.3, -0.2)
    assert read(IMU, imu((0.1, 0.2, 0.3))) == GyroSample(5, 0.1, 0.2, 0.3)
    assert read(IMU, imu((0.1, 0.2, 0.3), "base_link")) == GyroSample(5, 0.1, 0.2, 0.3, of_base=True)
    assert read(JOINT_STATE, joints(["arm", "left", "right"], [9.0, 2.0, 4.0])) == WheelSample(
        5, pytest.approx(0.3), 0.5
    )
    assert read(JOINT_STATE, joints(["arm"], [9.0])) is None
    without_turn = read(ODOMETRY, odometry(0.3, math.nan))
    assert isinstance(without_turn, WheelSample) and math.isnan(without_turn.yaw_rate_radps)


@pytest.mark.parametrize(
    ("kind", "data", "reason"),
    [
        (ODOMETRY, odometry(math.nan, 0.1), "not finite"),
        (ODOMETRY, odometry(0.1, math.inf), "not finite"),
        (IMU, imu((0, 0, math.nan)), "not finite"),
        (IMU, imu((0.0, 0.0, 0.0), covariance=-1.0), "covariance begins with -1"),
        (JOINT_STATE, joints(["left"], [1.0]), "no velocity of left or of right"),
        (JOINT_STATE, joints(["left", "right"], [1.0]), "no velocity of left or of right"),
        (JOINT_STATE, joints(["left", "right"], [1.0, math.inf]), "no velocity of left or of right"),
        (ODOMETRY, imu((0.0, 0.0, 0.0)), "truncated or invalid"),
    ],
)
def test_rates_that_are_none_are_refused(kind: str, data: bytes, reason: str) -> None:
    with pytest.raises(FrameDecodeError, match=reason):
        read(kind, data)


WHOLE = {
    COMPRESSED: image(LOWER, 10**18).data,
    IMAGE: image_message(10**18, "mono8", np.zeros((4, 5), np.uint8)),
    ODOMETRY: odometry(1.0, 1.0),
    IMU: imu((1.0, 1.0, 1.0)),
    JOINT_STATE: joints(["left", "right"], [1.0, 2.0]),
}


@pytest.mark.parametrize("kind", WHOLE)
def test_damaged_messages_raise_only_decode_errors(kind: str) -> None:
    chance, whole = random.Random(3), WHOLE[kind]

    def parse(data: bytes) -> object:
        return parse_image(kind, memoryview(data)) if kind in IMAGE_TYPES else read(kind, data)

    parse(whole)
    for size in range(0, len(whole) // 2, 3):
        with pytest.raises(FrameDecodeError):
            parse(whole[:size])
    for _ in range(500):
        changed = bytearray(whole)
        changed[chance.randrange(len(whole))] = chance.randrange(256)
        try:
            parse(bytes(changed))
        except FrameDecodeError as error:
            assert "\n" not in str(error)
