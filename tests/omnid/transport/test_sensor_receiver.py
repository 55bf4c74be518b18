"""Samples of wheels and gyro from the network: strict, bounded, counted."""

from __future__ import annotations

import numpy as np
import pytest
from rosbags.typesys.stores import ros2_humble as ros

from drivers.logs.ros_messages import JointWheels
from drivers.motion import GyroSample, MotionSample, WheelSample
from omnid.transport.codec import header_message, message_cdr
from omnid.transport.motion_codec import IMU_SCHEMA, JOINT_SCHEMA, gyro_cdr, wheel_cdr
from omnid.transport.sensor_receiver import SensorReceiver
from omnid.transport.topics import IMU, JOINT_STATES, SENSOR_TOPICS, WHEEL_ODOM
from tests.drivers.logs.mcap_logs import STORE

OFFSET_NS = 10**18
WHEELS, GYRO = WheelSample(5 * 10**9, 0.25, -0.5), GyroSample(6 * 10**9, 0.125, -0.25, 0.5, of_base=True)


@pytest.fixture
def lines() -> list[str]:
    return []


def receiver(taken: list[MotionSample], lines: list[str], *topics: str) -> SensorReceiver:
    joints = JointWheels("left", "right", 0.1, 0.5)
    return SensorReceiver(taken.append, OFFSET_NS, frozenset(topics or SENSOR_TOPICS), lines.append, joints)


def test_samples_arrive_in_the_time_of_the_images(lines: list[str]) -> None:
    taken: list[MotionSample] = []
    sensors = receiver(taken, lines)
    sensors.receive(WHEEL_ODOM, wheel_cdr(WHEELS, WHEELS.stamp_ns + OFFSET_NS))
    sensors.receive(IMU, gyro_cdr(GYRO, GYRO.stamp_ns + OFFSET_NS))
    assert taken == [WHEELS, GYRO] and not lines and not sensors.refused


def test_an_imu_that_measures_no_rates_is_no_gyro_that_stands(lines: list[str]) -> None:
    """By sensor_msgs/msg/Imu the first number of a covariance is -1 where nothing is measured."""
    message = STORE.deserialize_cdr(gyro_cdr(GYRO, OFFSET_NS + 5), IMU_SCHEMA)
    message.angular_velocity_covariance = np.array([-1.0, *[0.0] * 8])
    taken: list[MotionSample] = []
    sensors = receiver(taken, lines)
    sensors.receive(IMU, bytes(STORE.serialize_cdr(message, IMU_SCHEMA)))
    assert not taken and sensors.refused[IMU] == 1 and "no angular velocity" in lines[0]


def joint_cdr(names: list[str], velocities: list[float], stamp_ns: int = OFFSET_NS + 7) -> bytes:
    message = ros.sensor_msgs__msg__JointState(
        header_message(stamp_ns, ""), names, np.zeros(len(names)), np.array(velocities), np.zeros(0)
    )
    return message_cdr(message, JOINT_SCHEMA)


def test_wheels_are_joints_where_these_are_named(lines: list[str]) -> None:
    taken: list[MotionSample] = []
    joints = JointWheels("left", "right", 0.1, 0.5)
    sensors = SensorReceiver(taken.append, OFFSET_NS, frozenset([JOINT_STATES]), lines.append, joints)
    sensors.receive(JOINT_STATES, joint_cdr(["arm", "right", "left"], [9.0, 6.0, 4.0]))
    assert taken == [WheelSample(7, pytest.approx(0.5), pytest.approx(0.4))]
    sensors.receive(JOINT_STATES, joint_cdr(["arm"], [9.0]))
    assert len(taken) == 1 and not lines, "other joints have messages of their own"
    for names, velocities in ((["left"], [1.0]), (["left", "right"], []), (["left", "right"], [1.0, np.nan])):
        sensors.receive(JOINT_STATES, joint_cdr(names, velocities))
    sensors.receive(JOINT_STATES, joint_cdr(["left", "right"], [1.0, 1.0], stamp_ns=0))
    assert len(taken) == 1 and sensors.refused[JOINT_STATES] == 4
    assert len(lines) == 1 and "no velocity of left or of right" in lines[0]


@pytest.mark.hazard("H15")
def test_samples_from_the_network_are_checked(lines: list[str]) -> None:
    """No stamp, absurd or infinite rates, another source in use, damaged bytes: counted, one line for each topic."""
    taken: list[MotionSample] = []
    sensors = receiver(taken, lines)
    bad = [
        wheel_cdr(WHEELS, 0),
        wheel_cdr(WheelSample(1, 1000.0, 0.0), OFFSET_NS),
        wheel_cdr(WheelSample(1, np.inf, 0.0), OFFSET_NS),
        wheel_cdr(WheelSample(1, np.nan, 0.0), OFFSET_NS),
        wheel_cdr(WHEELS, OFFSET_NS) + bytes(10_000),
        b"",
    ]
    for payload in bad:
        sensors.receive(WHEEL_ODOM, payload)
    assert taken == [] and sensors.refused[WHEEL_ODOM] == len(bad) and len(lines) == 1
    only_imu = receiver(taken, lines, IMU)
    only_imu.receive(WHEEL_ODOM, wheel_cdr(WHEELS, OFFSET_NS))
    assert taken == [] and "motion.wheels" in lines[-1]
