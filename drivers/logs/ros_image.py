"""sensor_msgs/msg/Image and CompressedImage out of CDR bytes, without copying the image.

Written out here, not left to a general deserialiser, because these two messages are nearly all of a log and must
survive any bytes. The layout is that of the OMG's CDR (RTPS 2.2, 10.2): a 4-byte header, then each number aligned
to its own size counted from the end of that header.
"""

from __future__ import annotations

import struct
from dataclasses import dataclass

from drivers.errors import FrameDecodeError

IMAGE = "sensor_msgs/msg/Image"
COMPRESSED_IMAGE = "sensor_msgs/msg/CompressedImage"

# cv_bridge's names for images whose colours nobody declared, OpenCV's order being bgr; image_encodings.hpp's for YUV
_SAME_AS = {"8UC1": "mono8", "8UC3": "bgr8", "8UC4": "bgra8", "16UC1": "mono16",
            "yuv422_yuy2": "yuyv", "yuv422": "uyvy"}
_MAGIC = {b"\xff\xd8\xff": "jpeg", b"\x89PN": "png"}


@dataclass(frozen=True, slots=True, eq=False)
class RosImage:
    """One image message; the fields after data are 0 for compressed images."""

    stamp_ns: int  # header stamp, 0 where the sender left it unset
    encoding: str
    data: memoryview
    width: int = 0
    height: int = 0
    step: int = 0
    bigendian: bool = False


def parse_image(schema_name: str, message: memoryview) -> RosImage:
    """The image in a CDR message of type IMAGE or COMPRESSED_IMAGE; raises FrameDecodeError where there is none."""
    try:
        cdr = _Cdr(message)
        stamp_ns = _header(cdr)
        return _raw(cdr, stamp_ns) if schema_name == IMAGE else _compressed(cdr, stamp_ns)
    except struct.error as error:
        raise FrameDecodeError(f"a {schema_name} of {len(message)} bytes is cut short") from error


def _header(cdr: _Cdr) -> int:
    seconds, nanoseconds = cdr.number("i"), cdr.number("I")
    if seconds < 0 or nanoseconds >= 10**9:
        raise FrameDecodeError(f"a message has the impossible stamp {seconds} s {nanoseconds} ns")
    cdr.string()  # frame_id: which camera it is, the topic says
    return seconds * 10**9 + nanoseconds


def _raw(cdr: _Cdr, stamp_ns: int) -> RosImage:
    height, width, encoding = cdr.number("I"), cdr.number("I"), cdr.string()
    bigendian, step = bool(cdr.number("B")), cdr.number("I")
    return RosImage(stamp_ns, _SAME_AS.get(encoding, encoding), cdr.octets(), width, height, step, bigendian)


def _compressed(cdr: _Cdr, stamp_ns: int) -> RosImage:
    """The format field is free text such as 'bgr8; jpeg compressed bgr8', so the bytes themselves are asked first."""
    text, data = cdr.string(), cdr.octets()
    named = "jpeg" if "jp" in text.lower() else "png" if "png" in text.lower() else text
    return RosImage(stamp_ns, _MAGIC.get(bytes(data[:3]), named), data)


class _Cdr:
    """Reads CDR members one after the other; raises struct.error at the end of the bytes."""

    def __init__(self, message: memoryview) -> None:
        if len(message) < 4 or message[0] != 0 or message[1] not in (0, 1):
            raise FrameDecodeError(f"a message starts with {bytes(message[:4]).hex()}, not with a CDR header")
        self._order = "<" if message[1] else ">"
        self._body = message[4:]
        self._at = 0

    def number(self, code: str) -> int:
        size = struct.calcsize("=" + code)
        self._at += -self._at % size
        value: int = struct.unpack_from(self._order + code, self._body, self._at)[0]
        self._at += size
        return value

    def octets(self) -> memoryview:
        """A view of a sequence of bytes, which its length precedes."""
        size = self.number("I")
        block = self._body[self._at : self._at + size]
        if len(block) < size:
            raise struct.error(f"{size} bytes announced, {len(block)} there")
        self._at += size
        return block

    def string(self) -> str:
        return bytes(self.octets()[:256]).rstrip(b"\0").decode("utf-8", "replace")
