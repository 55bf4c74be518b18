"""Members of a ROS message in its bytes, one after the other, by ROS 2 (CDR) or ROS 1.

The layout is the OMG's CDR (RTPS 2.2, 10.2): a 4-byte header, then each number aligned to its own size, counted from
the end of the header. ROS 1 has the same members without header and alignment, little endian.
"""

from __future__ import annotations

import struct
from typing import Any

from drivers.errors import FrameDecodeError

_CDR_HEADER_BYTES = 4
_MAX_STRING = 256  # bytes


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
