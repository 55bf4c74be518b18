"""Samples of wheels and gyro as nav_msgs/msg/Odometry and sensor_msgs/msg/Imu, both ways."""

from __future__ import annotations

import random

import numpy as np
import pytest

from drivers.logs.ros_messages import JointWheels
from drivers.motion import GyroSample, MotionSample, WheelSample
from omnid.transport.motion_codec import gyro_cdr, wheel_cdr
from omnid.transport.sensor_receiver import SensorReceiver
from omnid.transport.topics import IMU, JOINT_STATES, SENSOR_TOPICS, WHEEL_ODOM
from tests.omnid.transport.test_sensor_receiver import joint_cdr

OFFSET_NS = 10**18


WHEELS, GYRO = WheelSample(5 * 10**9, 0.25, -0.5), GyroSample(6 * 10**9, 0.125, -0.25, 0.5, of_base=True)


@pytest.fixture
def lines() -> list[str]:
    return []


def receiver(taken: list[MotionSample], lines: list[str], *topics: str) -> SensorReceiver:
    joints = JointWheels("left", "right", 0.1, 0.5)
    return SensorReceiver(taken.append, OFFSET_NS, frozenset(topics or SENSOR_TOPICS), lines.append, joints)


def test_damaged_bytes_never_raise_and_give_finite_samples(lines: list[str]) -> None:
    rng, taken = random.Random(3), list[MotionSample]()
    sensors = receiver(taken, lines)
    for topic, payload in (
        (WHEEL_ODOM, wheel_cdr(WHEELS, OFFSET_NS + 1)),
        (IMU, gyro_cdr(GYRO, OFFSET_NS + 1)),
        (JOINT_STATES, joint_cdr(["left", "right"], [1.0, 2.0])),
    ):
        for _ in range(2000):
            damaged = bytearray(payload[: rng.randrange(len(payload) + 1)] if rng.random() < 0.3 else payload)
            for _ in range(rng.randrange(1, 6)):
                if damaged:
                    damaged[rng.randrange(len(damaged))] = rng.randrange(256)
            sensors.receive(topic, bytes(damaged))
    rates = [sample.velocity_mps if isinstance(sample, WheelSample) else sample.z_radps for sample in taken]
    assert len(taken) > 500 and np.isfinite(rates).all() and np.abs(rates).max() <= 100
