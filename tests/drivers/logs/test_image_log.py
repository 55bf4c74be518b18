"""Messages of a log are decoded when they are read, those of images and of motion only."""

from __future__ import annotations

import numpy as np
import pytest

from drivers.errors import FrameDecodeError
from drivers.logs.image_log import LoggedImage, LoggedMotion, logged_message
from drivers.logs.ros_image import IMAGE
from drivers.logs.ros_motion import IMU
from tests.drivers.logs.mcap_logs import image_message


def test_an_image_is_decoded_when_it_is_read() -> None:
    asked = list[str]()

    def data() -> memoryview:
        asked.append("data")
        return memoryview(image_message(7, "mono8", np.zeros((3, 4), np.uint8)))

    found = logged_message("/a", IMAGE, 9, data)
    assert isinstance(found, LoggedImage) and (found.topic, found.log_time_ns, asked) == ("/a", 9, [])
    assert found.read().stamp_ns == 7 and asked == ["data"]


def test_motion_is_decoded_when_it_is_read_and_other_types_are_left_out() -> None:
    found = logged_message("/imu", IMU, 9, lambda: memoryview(b"\0\1\0\0"))
    assert isinstance(found, LoggedMotion)
    with pytest.raises(FrameDecodeError, match="truncated"):
        found.read(None)
    assert logged_message("/a", "std_msgs/msg/String", 9, lambda: memoryview(b"")) is None
