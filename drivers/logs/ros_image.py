"""Decodes sensor_msgs/msg/Image and CompressedImage from the bytes of ROS 2 (CDR) or ROS 1, without copying the image.

A decoder of its own, not a general one, since these two messages are nearly all of a log and invalid bytes must be
detected.
"""

from __future__ import annotations

import struct
from dataclasses import dataclass

from drivers.errors import FrameDecodeError
from drivers.frame import Camera, Frame
from drivers.logs.ros_members import MemberReader, cdr_members, header_stamp

IMAGE = "sensor_msgs/msg/Image"
COMPRESSED_IMAGE = "sensor_msgs/msg/CompressedImage"
IMAGE_TYPES = (IMAGE, COMPRESSED_IMAGE)

# cv_bridge's names for images without declared colours, in OpenCV's order bgr, and image_encodings.hpp's names of YUV
_SYNONYMS = {
    "8UC1": "mono8",
    "8UC3": "bgr8",
    "8UC4": "bgra8",
    "16UC1": "mono16",
    "yuv422_yuy2": "yuyv",
    "yuv422": "uyvy",
}
_MAGIC = {b"\xff\xd8\xff": "jpeg", b"\x89PN": "png"}
_MAGIC_BYTES = 3


@dataclass(frozen=True, slots=True, eq=False)
class RosImage:
    """One image message; the fields after data are 0 for compressed images."""

    stamp_ns: int  # stamp of the header, 0 if unset
    encoding: str  # as in drivers.frame.Frame
    data: memoryview
    width: int = 0  # px
    height: int = 0  # px
    step: int = 0  # bytes from row to row
    bigendian: bool = False

    def frame(self, camera: Camera = "lower", seq: int = 0) -> Frame:
        """Return the image as a frame of a camera. To decode it, neither the camera nor the number matters."""
        layout = self.width, self.height, self.step, self.bigendian
        return Frame(seq, self.stamp_ns, camera, self.encoding, self.data, *layout)


def parse_image(schema_name: str, message: memoryview, *, aligned: bool = True) -> RosImage:
    """Return the image in a message of type IMAGE or COMPRESSED_IMAGE; raise FrameDecodeError where it is invalid.

    aligned: True for CDR (ROS 2), False for the serialisation of ROS 1.
    """
    try:
        members = cdr_members(message) if aligned else MemberReader(message, "<", aligned=False)
        stamp_ns = header_stamp(members)
        return _raw(members, stamp_ns) if schema_name == IMAGE else _compressed(members, stamp_ns)
    except struct.error as error:
        raise FrameDecodeError(f"a {schema_name} of {len(message)} bytes is truncated") from error


def _raw(members: MemberReader, stamp_ns: int) -> RosImage:
    height, width, encoding = members.number("I"), members.number("I"), members.string()
    bigendian, step = bool(members.number("B")), members.number("I")
    return RosImage(stamp_ns, _SYNONYMS.get(encoding, encoding), members.octets(), width, height, step, bigendian)


def _compressed(members: MemberReader, stamp_ns: int) -> RosImage:
    """Return a compressed image; its first bytes decide the encoding, else the format field, which is free text."""
    encoding, data = members.string(), members.octets()
    if "jp" in encoding.lower():  # such as 'bgr8; jpeg compressed bgr8'
        encoding = "jpeg"
    elif "png" in encoding.lower():
        encoding = "png"
    return RosImage(stamp_ns, image_encoding(data, encoding), data)


def image_encoding(data: memoryview | bytes, otherwise: str = "") -> str:
    """Return jpeg or png by the first bytes of an image file, `otherwise` where it is neither."""
    return _MAGIC.get(bytes(data[:_MAGIC_BYTES]), otherwise)
