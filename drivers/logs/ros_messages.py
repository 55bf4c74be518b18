"""Images, wheels and gyros in the messages of ROS 2 (CDR), decoded by rosbags, which copies no image."""

from __future__ import annotations

import math
import struct
from functools import cache
from typing import Any, Final

from rosbags.typesys import Stores, get_typestore

from drivers.errors import FrameDecodeError
from drivers.frame import Frame
from drivers.motion import GyroSample, MotionSample, WheelSample

IMAGE: Final = "sensor_msgs/msg/Image"
COMPRESSED_IMAGE: Final = "sensor_msgs/msg/CompressedImage"
IMAGE_TYPES: Final = (IMAGE, COMPRESSED_IMAGE)
ODOMETRY: Final = "nav_msgs/msg/Odometry"
IMU: Final = "sensor_msgs/msg/Imu"
STAMPED_TYPES: Final = (*IMAGE_TYPES, ODOMETRY, IMU)  # which begin with a header, whose stamp is used
BASE_FRAME: Final = "base_link"  # Frame of messages whose axes are those of the base (REP 105), as omnid records them.
CDR: Final = b"\0\1\0\0"  # with which messages in little-endian CDR begin
HEADER: Final = struct.Struct("<4xiI")  # of messages: after four bytes seconds, nanoseconds

# cv_bridge's names for images without declared colours, in OpenCV's order bgr, and image_encodings.hpp's names of YUV
_SYNONYMS: Final = {
    "8UC1": "mono8",
    "8UC3": "bgr8",
    "8UC4": "bgra8",
    "16UC1": "mono16",
    "16UC3": "bgr16",
    "16UC4": "bgra16",
    "yuv422_yuy2": "yuyv",
    "yuv422": "uyvy",
}
_MAGIC: Final = {b"\xff\xd8\xff": "jpeg", b"\x89PN": "png"}


def parse_image(kind: str, message: memoryview) -> Frame:
    """Return the image in a message of type IMAGE or COMPRESSED_IMAGE, as frame 0 of the lower camera.

    Its stamp is that of the header, 0 if unset. Raise FrameDecodeError where the message is invalid.
    """
    found = _decoded(kind, message)
    stamp_ns, data = _stamp_ns(found.header.stamp.sec, found.header.stamp.nanosec), memoryview(found.data)
    if kind == IMAGE:
        encoding, is_big = _SYNONYMS.get(found.encoding, found.encoding), bool(found.is_bigendian)
        return Frame(0, stamp_ns, "lower", encoding, data, found.width, found.height, found.step, is_big)
    encoding = found.format
    # image_transport compresses a Bayer pattern as it is, and says so: 'bayer_rggb8; jpeg compressed '.
    source = encoding.partition(";")[0].strip()
    bayer = source if source.startswith("bayer_") else ""
    # The first bytes decide the encoding, else the format, which is free text such as 'bgr8; jpeg compressed bgr8'.
    encoding = next((name for name, part in (("jpeg", "jp"), ("png", "png")) if part in encoding.lower()), encoding)
    return Frame(0, stamp_ns, "lower", _MAGIC.get(bytes(data[:3]), encoding), data, bayer=bayer)


def compressed_image(stamp_ns: int, image: bytes) -> bytes:
    """Return an image file as a COMPRESSED_IMAGE in CDR, with an empty frame and format."""
    # Both strings have a length of 1, for the zero that ends them, and are filled up to four bytes.
    head = struct.pack("<4siII4xI4xI", CDR, *divmod(stamp_ns, 10**9), 1, 1, len(image))
    return head + image


def parse_motion(kind: str, message: memoryview) -> MotionSample:
    """Return the sample in a message of type ODOMETRY or IMU.

    Its stamp is that of the header, 0 if unset. Raise FrameDecodeError where the message is invalid.
    """
    found = _decoded(kind, message)
    stamp_ns = _stamp_ns(found.header.stamp.sec, found.header.stamp.nanosec)
    if kind == ODOMETRY:
        velocity_mps, yaw_rate_radps = found.twist.twist.linear.x, found.twist.twist.angular.z
        if not math.isfinite(velocity_mps) or math.isinf(yaw_rate_radps):  # wheels may not report their turn
            raise FrameDecodeError(f"a {kind} has rates that are not finite")
        return WheelSample(stamp_ns, velocity_mps, yaw_rate_radps)
    if found.angular_velocity_covariance[0] == -1.0:  # of what is not measured (sensor_msgs/msg/Imu)
        raise FrameDecodeError(f"a {IMU} has no angular velocity: its covariance begins with -1")
    x, y, z = found.angular_velocity.x, found.angular_velocity.y, found.angular_velocity.z
    if not all(map(math.isfinite, (x, y, z))):
        raise FrameDecodeError(f"a {kind} has rates that are not finite")
    return GyroSample(stamp_ns, x, y, z, of_base=found.header.frame_id == BASE_FRAME)


def _decoded(kind: str, message: memoryview) -> Any:
    """Return a message as rosbags decodes it; raise FrameDecodeError for other bytes."""
    try:
        return typestore(Stores.ROS2_HUMBLE).deserialize_cdr(message, kind)
    except Exception as error:  # of any kind, as it trusts the lengths in the bytes
        raise FrameDecodeError(f"a {kind} of {len(message)} bytes is truncated or invalid") from error


def header_stamp(message: memoryview) -> int:
    """Return the stamp [ns] of the header with which images, wheels and IMUs begin; 0 where unset, -1 where cut."""
    start = bytes(message[: HEADER.size])
    if len(start) < HEADER.size:
        return -1
    # CDR states its byte order.
    return _stamp_ns(*struct.unpack(HEADER.format if start[1] & 1 else ">4xiI", start))


typestore = cache(get_typestore)


def _stamp_ns(seconds: int, nanoseconds: int) -> int:
    """Return the stamp of a header, 0 where there is none; some drivers do not carry nanoseconds over to seconds."""
    return seconds * 10**9 + nanoseconds if seconds >= 0 else 0
