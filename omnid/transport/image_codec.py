"""Frames as image messages of ROS 2, on topics that ROS tools and `omnid replay` recognise.

CDR is written here (OMG RTPS 2.2, 10.2: little-endian, numbers aligned to their size), not by rosbags: images are
nearly all of a recording, and this copies each of them once. drivers.logs.ros_messages reads it.
"""

from __future__ import annotations

from struct import pack
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from drivers.frame import Frame
from drivers.logs.ros_messages import COMPRESSED_IMAGE, IMAGE
from omnid.transport.codec import ros_time

COMPRESSED: Final = ("jpeg", "png")
# Encoding in drivers.frame -> name in sensor_msgs/image_encodings.hpp, where that is different.
_ROS_NAMES: Final = {"yuyv": "yuv422_yuy2", "uyvy": "yuv422"}
_PIXEL_BYTES: Final = {"mono16": 2, "bgr8": 3, "rgb8": 3, "bgra8": 4, "rgba8": 4, "yuyv": 2, "uyvy": 2}


def image_topic(frame: Frame) -> str:
    """Return the frame's topic below the robot's name, such as lower/image_raw/compressed."""
    return f"{frame.camera}/image_raw" + ("/compressed" if frame.encoding in COMPRESSED else "")


def image_cdr(frame: Frame, stamp_ns: int) -> tuple[str, bytes]:
    """Return schema and CDR bytes of an undecoded frame with the given stamp [ns of Unix time]; frame_id is the camera.

    Raise OmnidError where the stamp does not fit a ROS time.
    """
    header = _aligned(pack("<iI", *ros_time(stamp_ns)) + _string(frame.camera))
    data = np.frombuffer(frame.data, np.uint8)
    if frame.encoding in COMPRESSED:
        return COMPRESSED_IMAGE, _message(_aligned(header + _string(frame.encoding)), data)
    step = frame.step or frame.width * _PIXEL_BYTES.get(frame.encoding, 1)
    size, name = pack("<II", frame.height, frame.width), _ROS_NAMES.get(frame.encoding, frame.encoding)
    layout = _aligned(size + _string(name) + bytes([frame.bigendian])) + pack("<I", step)
    return IMAGE, _message(header + layout, data[: step * _rows(frame)])


def _rows(frame: Frame) -> int:
    """Return the rows of a whole image; a driver's buffer may be longer, which ROS does not accept."""
    return frame.height * 3 // 2 if frame.encoding == "nv12" else frame.height  # the colour planes follow as rows


def _message(head: bytes, data: NDArray[Any]) -> bytes:
    """Join a message of its head, a multiple of 4 bytes, and the array of its data."""
    return b"".join((b"\0\1\0\0", head, pack("<I", data.size), data.data))


def _string(text: str) -> bytes:
    data = text.encode() + b"\0"
    return pack("<I", len(data)) + data


def _aligned(block: bytes) -> bytes:
    return block + bytes(-len(block) % 4)
