"""Decodes sensor_msgs/msg/Image and CompressedImage from CDR bytes, without copying the image.

A decoder of its own, not a general one, since these two messages are nearly all of a log and invalid bytes must be
detected. The layout is the OMG's CDR (RTPS 2.2, 10.2): a 4-byte header, then each number aligned to its own size,
counted from the end of the header.
"""

from __future__ import annotations

import struct
from dataclasses import dataclass

from drivers.errors import FrameDecodeError

IMAGE = "sensor_msgs/msg/Image"
COMPRESSED_IMAGE = "sensor_msgs/msg/CompressedImage"

# cv_bridge's names for images without declared colours, in OpenCV's order bgr, and image_encodings.hpp's names of YUV
_SYNONYMS = {"8UC1": "mono8", "8UC3": "bgr8", "8UC4": "bgra8", "16UC1": "mono16",
            "yuv422_yuy2": "yuyv", "yuv422": "uyvy"}
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


def parse_image(schema_name: str, message: memoryview) -> RosImage:
    """Return the image in a CDR message of type IMAGE or COMPRESSED_IMAGE; raise FrameDecodeError where it is invalid.
    """
    try:
        cdr = _CdrReader(message)
        stamp_ns = _header(cdr)
        return _raw(cdr, stamp_ns) if schema_name == IMAGE else _compressed(cdr, stamp_ns)
    except struct.error as error:
        raise FrameDecodeError(f"a {schema_name} of {len(message)} bytes is truncated") from error


def _header(cdr: _CdrReader) -> int:
    """Return the stamp of a std_msgs/Header [ns]."""
    seconds, nanoseconds = cdr.number("i"), cdr.number("I")
    if seconds < 0 or nanoseconds >= 10**9:
        raise FrameDecodeError(f"a message has the invalid stamp {seconds} s {nanoseconds} ns")
    cdr.string()  # frame_id, which is not used: the topic identifies the camera
    return seconds * 10**9 + nanoseconds


def _raw(cdr: _CdrReader, stamp_ns: int) -> RosImage:
    height, width, encoding = cdr.number("I"), cdr.number("I"), cdr.string()
    bigendian, step = bool(cdr.number("B")), cdr.number("I")
    return RosImage(stamp_ns, _SYNONYMS.get(encoding, encoding), cdr.octets(), width, height, step, bigendian)


def _compressed(cdr: _CdrReader, stamp_ns: int) -> RosImage:
    """Return a compressed image; its first bytes decide the encoding, else the format field, which is free text."""
    encoding, data = cdr.string(), cdr.octets()
    if "jp" in encoding.lower():  # such as 'bgr8; jpeg compressed bgr8'
        encoding = "jpeg"
    elif "png" in encoding.lower():
        encoding = "png"
    return RosImage(stamp_ns, _MAGIC.get(bytes(data[:_MAGIC_BYTES]), encoding), data)


class _CdrReader:
    """Reads the members of a CDR message in order; raises struct.error at the end of the bytes."""

    def __init__(self, message: memoryview) -> None:
        if len(message) < _CDR_HEADER_BYTES or message[0] != 0 or message[1] not in (0, 1):
            start = bytes(message[:_CDR_HEADER_BYTES]).hex()
            raise FrameDecodeError(f"a message starts with {start}, not with a CDR header")
        self._order = "<" if message[1] else ">"  # CDR_LE or CDR_BE
        self._body = message[_CDR_HEADER_BYTES:]
        self._offset = 0

    def number(self, code: str) -> int:
        """Return a number; code: its format in struct."""
        size = struct.calcsize("=" + code)
        self._offset += -self._offset % size  # alignment
        value: int = struct.unpack_from(self._order + code, self._body, self._offset)[0]
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
