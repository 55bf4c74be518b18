"""The hand-written CDR parser against rosbags' deserialiser."""

from __future__ import annotations

from itertools import product

import numpy as np
import pytest

from drivers.logs.ros_image import COMPRESSED_IMAGE, IMAGE, parse_image
from tests.drivers.logs.mcap_logs import STORE, TYPES, header


@pytest.mark.parametrize("little_endian", [True, False])
def test_agrees_with_rosbags_at_every_alignment(little_endian: bool) -> None:
    frame_ids, sizes = ("", "a", "abc", "lower_optical_frame"), (0, 1, 6, 1001)
    texts = ("jpeg", "", "mono8", "bgr8; jpeg compressed bgr8")
    for frame_id, text, size in product(frame_ids, texts, sizes):
        assert_agrees_with_rosbags(little_endian, frame_id, text, size)


def assert_agrees_with_rosbags(little_endian: bool, frame_id: str, text: str, size: int) -> None:
    data = np.random.default_rng(size).integers(0, 256, size, np.uint8)
    stamped = header(1_700_000_000_123_456_789, frame_id)
    messages = {
        COMPRESSED_IMAGE: TYPES[COMPRESSED_IMAGE](stamped, text, data),
        IMAGE: TYPES[IMAGE](stamped, 480, 2**31 + 5, text, 1, 2**32 - 1, data),
    }
    for kind, message in messages.items():
        cdr = memoryview(STORE.serialize_cdr(message, kind, little_endian=little_endian))
        expected, found = STORE.deserialize_cdr(cdr, kind), parse_image(kind, cdr)
        assert found.stamp_ns == expected.header.stamp.sec * 10**9 + expected.header.stamp.nanosec
        assert bytes(found.data) == expected.data.tobytes()
        if kind == IMAGE:
            sizes = (expected.width, expected.height, expected.step, expected.encoding)
            assert (found.width, found.height, found.step, found.encoding) == sizes and found.bigendian
