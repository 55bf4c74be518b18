"""Frames and samples of the drivers as messages of ROS 2, on topics that ROS tools and `omnid replay` recognise.

Images: CompressedImage and Image. Wheels: Odometry. Gyro: Imu.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import astuple, replace
from typing import Final

import numpy as np

from drivers.errors import FrameDecodeError
from drivers.frame import Frame
from drivers.logs.ros_messages import BASE_FRAME, COMPRESSED_IMAGE, IMAGE, parse_motion
from drivers.motion import GyroSample, MotionSample, WheelSample
from omnid.errors import OmnidError
from omnid.transport.codec import IMU_SCHEMA, encoded, odometry_cdr

LARGEST_VALUE: Final = 100.0  # m/s, rad/s and rad: larger ones are faults of the sender
_UNKNOWN_VARIANCE: Final = 1e9  # Variance of the parts of a pose that wheels do not measure.


def wheel_cdr(sample: WheelSample, stamp_ns: int) -> bytes:
    """Encode the velocity by the wheels as an Odometry; the pose in the message is unknown."""
    velocity = np.array([sample.velocity_mps, 0, 0, 0, 0, sample.yaw_rate_radps])
    return odometry_cdr(stamp_ns, np.eye(4), _UNKNOWN_VARIANCE * np.eye(6), velocity, np.zeros((6, 6)))


def gyro_cdr(sample: GyroSample, stamp_ns: int, frame: str = BASE_FRAME) -> bytes:
    """Encode angular velocities about the axes of a frame as an Imu."""
    unknown = np.array([-1.0, *[0.0] * 8])  # REP 145: the message has no orientation, and no acceleration
    rates = sample.x_radps, sample.y_radps, sample.z_radps
    orientation, acceleration = (0.0, 0.0, 0.0, 1.0), (0.0, 0.0, 0.0)
    parts = orientation, unknown, rates, np.zeros(9), acceleration, unknown
    return encoded(IMU_SCHEMA, (stamp_ns, frame), *parts)


def sample_from_cdr(payload: bytes, schema: str, stamp_ns: Callable[[int], int]) -> MotionSample:
    """Decode a sample of an Odometry or an Imu with a stamp; rates that are absurd or not finite are refused.

    stamp_ns: returns the stamp, as those of images, of a Unix time.
    """
    try:
        sample = parse_motion(schema, memoryview(payload))
    except FrameDecodeError as error:
        raise OmnidError(str(error)) from error
    if not sample.stamp_ns:
        raise OmnidError(f"a {schema} has no stamp; fill in header.stamp")
    if any(abs(rate) > LARGEST_VALUE for rate in astuple(sample)[1:] if math.isfinite(rate)):
        raise OmnidError(f"a {schema} has rates above {LARGEST_VALUE:.0f} m/s or rad/s: check its units")
    return replace(sample, stamp_ns=stamp_ns(sample.stamp_ns))


COMPRESSED: Final = ("jpeg", "png")
# Encoding in drivers.frame -> name in sensor_msgs/image_encodings.hpp, where that is different.
_ROS_NAMES: Final = {"yuyv": "yuv422_yuy2", "uyvy": "yuv422"}


def image_topic(frame: Frame) -> str:
    """Return the frame's topic below the robot's name, such as lower/image_raw/compressed."""
    return f"{frame.camera}/image_raw" + ("/compressed" if frame.encoding in COMPRESSED else "")


def image_cdr(frame: Frame, stamp_ns: int) -> tuple[str, bytes]:
    """Return schema and CDR bytes of an undecoded frame with the given stamp [ns of Unix time]; frame_id: its camera.

    A driver's buffer may be longer than its image, which ROS does not accept: the rest is left out.
    """
    head, data = (stamp_ns, frame.camera), np.frombuffer(frame.data, np.uint8)
    if frame.encoding in COMPRESSED:
        return COMPRESSED_IMAGE, encoded(COMPRESSED_IMAGE, head, frame.encoding, data)
    rows = frame.height * 3 // 2 if frame.encoding == "nv12" else frame.height  # the colour planes follow as rows
    step = frame.step or len(data) // rows
    name = _ROS_NAMES.get(frame.encoding, frame.encoding)
    return IMAGE, encoded(IMAGE, head, frame.height, frame.width, name, int(frame.bigendian), step, data[: step * rows])
