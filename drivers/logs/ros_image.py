"""Decodes sensor_msgs/msg/Image and CompressedImage from the bytes of ROS 2 (CDR) or ROS 1, without copying the image.

A decoder of its own, not a general one, since these two messages are nearly all of a log and invalid bytes must be
detected. The layout is the OMG's CDR (RTPS 2.2, 10.2): a 4-byte header, then each number aligned to its own size,
counted from the end of the header. ROS 1 has the same members without header and alignment, little endian.
"""

from __future__ import annotations

import struct
from dataclasses import dataclass
from typing import Any

from drivers.errors import FrameDecodeError
from drivers.frame import Camera, Frame

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
_CDR_HEADER_BYTES = 4
_MAX_STRING = 256  # bytes


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


def header_stamp(members: MemberReader) -> int:
    """Return the stamp of a std_msgs/Header [ns]; its frame is not used: the topic identifies the camera."""
    return header(members)[0]


def header(members: MemberReader) -> tuple[int, str]:
    """Return the stamp of a std_msgs/Header [ns] and its frame."""
    if not members.aligned:
        members.number("I")  # the sequence number that a header has in ROS 1
    seconds: int = members.number("i")
    nanoseconds: int = members.number("I")
    if seconds < 0 or nanoseconds >= 10**9:
        raise FrameDecodeError(f"a message has the invalid stamp {seconds} s {nanoseconds} ns")
    return seconds * 10**9 + nanoseconds, members.string()


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


class MemberReader:
    """Reads the members of a message in order; raises struct.error at the end of the bytes."""

    def __init__(self, body: memoryview, order: str, aligned: bool) -> None:
        """order: "<" little endian, ">" big endian. aligned: each number begins at a multiple of its size."""
        self._order, self._body, self.aligned, self._offset = order, body, aligned, 0

    def number(self, code: str) -> Any:
        """Return a number; code: its format in struct."""
        size = struct.calcsize("=" + code)
        self._offset += -self._offset % size if self.aligned else 0
        value = struct.unpack_from(self._order + code, self._body, self._offset)[0]
        self._offset += size
        return value

    def octets(self) -> memoryview:
        """Return a view of a sequence of bytes, which starts with its length."""
        size = self.number("I")
        block = self._body[self._offset : self._offset + size]
        if len(block) < size:
            raise struct.error(f"{size} bytes expected, {len(block)} found")
        self._offset += size
        return block

    def string(self) -> str:
        """Return a string, truncated to 256 bytes."""
        return bytes(self.octets()[:_MAX_STRING]).rstrip(b"\0").decode("utf-8", "replace")


def cdr_members(message: memoryview) -> MemberReader:
    """Return a reader of the members of a CDR message; raise FrameDecodeError where it has no header."""
    if len(message) < _CDR_HEADER_BYTES or message[0] != 0 or message[1] not in (0, 1):
        start = bytes(message[:_CDR_HEADER_BYTES]).hex()
        raise FrameDecodeError(f"a message starts with {start}, not with a CDR header")
    return MemberReader(message[_CDR_HEADER_BYTES:], "<" if message[1] else ">", aligned=True)  # CDR_LE or CDR_BE
