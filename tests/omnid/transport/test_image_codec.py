"""Frames as image messages of ROS 2, on topics that ROS tools and `omnid replay` recognise."""

from __future__ import annotations

from typing import Any

import pytest

from drivers.frame import Frame
from omnid.errors import OmnidError
from omnid.transport.image_codec import image_cdr, image_topic
from tests.drivers.logs.mcap_logs import STORE
from tests.omnid.sinks.test_recorder import frame

START_NS = 1_700_000_000 * 10**9


WIDTH, HEIGHT = 6, 4


LENGTHS = {"mono8": 1, "mono16": 2, "bgr8": 3, "rgb8": 3, "bgra8": 4, "rgba8": 4, "yuyv": 2, "uyvy": 2, "nv12": 1}


@pytest.mark.parametrize("encoding", ["jpeg", *LENGTHS])
def test_image_messages_have_the_layout_of_ros(encoding: str) -> None:
    each = frame(7, "upper", encoding)
    schema, payload = image_cdr(each, START_NS + 5)
    message: Any = STORE.deserialize_cdr(payload, schema)
    assert bytes(STORE.serialize_cdr(message, schema)) == payload
    stamp = message.header.stamp
    assert (stamp.sec, stamp.nanosec, message.header.frame_id) == (1_700_000_000, 5, "upper")
    if encoding == "jpeg":
        assert (message.format, bytes(message.data)) == ("jpeg", each.data)
        return
    names = {"yuyv": "yuv422_yuy2", "uyvy": "yuv422"}
    assert (message.encoding, message.width, message.height) == (names.get(encoding, encoding), WIDTH, HEIGHT)
    rows = HEIGHT * 3 // 2 if encoding == "nv12" else HEIGHT
    assert message.step == each.step and bytes(message.data) == bytes(each.data)[: each.step * rows]


def test_rows_without_padding_get_their_step() -> None:
    packed = Frame(0, 0, "lower", "bgr8", bytes(WIDTH * HEIGHT * 3), WIDTH, HEIGHT)
    message: Any = STORE.deserialize_cdr(image_cdr(packed, 0)[1], "sensor_msgs/msg/Image")
    assert message.step == WIDTH * 3 and image_topic(packed) == "lower/image_raw"
    with pytest.raises(OmnidError, match="-1 ns"):
        image_cdr(packed, -1)
