"""A stream of a capture device: errors of the system name what to do."""

from __future__ import annotations

import errno
import os

import pytest

from drivers.cameras.v4l2_settings import V4l2Settings
from drivers.cameras.v4l2_stream import StreamFormat, V4l2Stream, device_error
from drivers.errors import DriverError


@pytest.mark.parametrize(
    ("number", "advice"),
    [(errno.EBUSY, "used by another program"), (errno.ENOSPC, "choose MJPG"), (errno.EIO, "Input/output error")],
)
def test_errors_of_the_system_have_advice(number: int, advice: str) -> None:
    message = str(device_error("/dev/video0", OSError(number, os.strerror(number))))
    assert message.startswith("camera /dev/video0 ") and advice in message and "\n" not in message


def test_what_is_no_video_device_leaves_nothing_open() -> None:
    before = len(os.listdir("/proc/self/fd"))
    with pytest.raises(DriverError, match="is not a video device; `omnid cameras` lists those that are"):
        V4l2Stream(V4l2Settings("/dev/null"))
    assert len(os.listdir("/proc/self/fd")) == before


def test_a_format_has_the_least_size_of_its_images() -> None:
    grey, mjpg = StreamFormat("GREY", 640, 480, 640, 30.0), StreamFormat("MJPG", 640, 480, 0, 0.0)
    assert (grey.min_bytes, grey.encoding, str(grey)) == (640 * 480, "mono8", "GREY 640x480 at 30 Hz")
    assert (mjpg.min_bytes, mjpg.encoding, str(mjpg)) == (1, "jpeg", "MJPG 640x480")
