"""Samples of wheels and gyro as nav_msgs/msg/Odometry and sensor_msgs/msg/Imu, both ways; wheels of a JointState."""

from __future__ import annotations

import math
from typing import Final

import numpy as np

from drivers.errors import FrameDecodeError
from drivers.logs.ros_messages import BASE_FRAME, JointWheels, parse_motion
from drivers.motion import GyroSample, MotionSample, WheelSample
from omnid.errors import OmnidError
from omnid.transport import ros_types as ros
from omnid.transport.codec import IMU_SCHEMA, ODOMETRY_SCHEMA, header_message, message_cdr, odometry_cdr

WHEEL_SCHEMA: Final = ODOMETRY_SCHEMA
LARGEST_RATE: Final = 100.0  # m/s and rad/s: larger ones are faults of the sender
_UNKNOWN_VARIANCE: Final = 1e9  # Variance of the parts of a pose that wheels do not measure.
_UNKNOWN: Final = np.array([-1.0, *[0.0] * 8])  # REP 145: the message has no orientation, and no acceleration


def wheel_cdr(sample: WheelSample, stamp_ns: int) -> bytes:
    """Encode the velocity by the wheels; the pose in the message is unknown."""
    velocity = np.array([sample.velocity_mps, 0, 0, 0, 0, sample.yaw_rate_radps])
    return odometry_cdr(stamp_ns, np.eye(4), _UNKNOWN_VARIANCE * np.eye(6), velocity, np.zeros((6, 6)))


def gyro_cdr(sample: GyroSample, stamp_ns: int, frame: str = BASE_FRAME) -> bytes:
    """Encode angular velocities about the axes of a frame."""
    rates = ros.geometry_msgs__msg__Vector3(sample.x_radps, sample.y_radps, sample.z_radps)
    message = ros.sensor_msgs__msg__Imu(
        header_message(stamp_ns, frame),
        ros.geometry_msgs__msg__Quaternion(0.0, 0.0, 0.0, 1.0),
        _UNKNOWN,
        rates,
        np.zeros(9),
        ros.geometry_msgs__msg__Vector3(0.0, 0.0, 0.0),
        _UNKNOWN,
    )
    return message_cdr(message, IMU_SCHEMA)


def sample_from_cdr(
    payload: bytes, schema: str, offset_ns: int, joints: JointWheels | None = None
) -> MotionSample | None:
    """Decode a sample from the network; None for a JointState that has no wheel.

    offset_ns: from the stamps of images to the sender's clock. joints: the wheels in a JointState.

    Raise OmnidError for a message without a stamp, with rates that are not finite or absurd, and for other bytes.
    """
    try:
        reading = parse_motion(schema, memoryview(payload), joints=joints)
    except FrameDecodeError as error:
        raise OmnidError(str(error)) from error
    if not reading.rates:
        return None
    if not reading.stamp_ns:
        raise OmnidError(f"a {schema} has no stamp; fill in header.stamp")
    if any(abs(rate) > LARGEST_RATE for rate in reading.rates if math.isfinite(rate)):
        raise OmnidError(f"a {schema} has rates above {LARGEST_RATE:.0f} m/s or rad/s: check its units")
    return reading._replace(stamp_ns=reading.stamp_ns - offset_ns).sample(0)
