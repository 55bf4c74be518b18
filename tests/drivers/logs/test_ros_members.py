"""Members of ROS messages in both serialisations."""

from __future__ import annotations

import struct

import pytest

from drivers.errors import FrameDecodeError
from drivers.logs.ros_members import MemberReader, cdr_members, header, header_stamp


@pytest.mark.parametrize(("order", "kind"), [("<", 1), (">", 0)])
def test_cdr_aligns_each_number_to_its_size(order: str, kind: int) -> None:
    body = struct.pack(f"{order}B3xIH6xd", 7, 8, 9, 0.5)
    members = cdr_members(memoryview(bytes([0, kind, 0, 0]) + body))
    assert [members.number(code) for code in "BIHd"] == [7, 8, 9, 0.5]


def test_ros1_has_no_gaps() -> None:
    members = MemberReader(memoryview(struct.pack("<BIHd", 7, 8, 9, 0.5)), "<", aligned=False)
    assert [members.number(code) for code in "BIHd"] == [7, 8, 9, 0.5]


def test_strings_are_bounded_and_sequences_end_with_the_message() -> None:
    data = memoryview(struct.pack("<I", 300) + b"a" * 300 + struct.pack("<I", 9) + b"short")
    members = MemberReader(data, "<", aligned=False)
    assert members.string() == "a" * 256
    with pytest.raises(struct.error, match="9 bytes expected, 5 found"):
        members.octets()


def test_a_header_of_ros1_has_a_number_first() -> None:
    text = struct.pack("<I", 4) + b"cam\0"
    aligned = MemberReader(memoryview(struct.pack("<iI", 3, 5) + text), "<", aligned=True)
    assert header(aligned) == (3 * 10**9 + 5, "cam")
    assert (
        header_stamp(MemberReader(memoryview(struct.pack("<IiI", 9, 3, 5) + text), "<", aligned=False)) == 3 * 10**9 + 5
    )


@pytest.mark.parametrize(("seconds", "nanoseconds"), [(-1, 0), (0, 10**9)])
def test_impossible_stamps_are_refused(seconds: int, nanoseconds: int) -> None:
    with pytest.raises(FrameDecodeError, match="invalid stamp"):
        header(MemberReader(memoryview(struct.pack("<iI", seconds, nanoseconds)), "<", aligned=True))


@pytest.mark.parametrize("start", [b"", b"\0\1\0", b"\1\1\0\0", b"\0\2\0\0"])
def test_other_bytes_have_no_header(start: bytes) -> None:
    with pytest.raises(FrameDecodeError, match="not with a CDR header"):
        cdr_members(memoryview(start))
