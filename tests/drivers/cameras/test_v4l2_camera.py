"""A V4L2 camera as a source of frames that survives being unplugged."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

from drivers.cameras.v4l2_camera import V4l2Camera
from drivers.cameras.v4l2_settings import V4l2Settings
from drivers.errors import DriverError


@pytest.mark.parametrize(("name", "message"), [("missing", "is not there"), ("file", "is not a video device")])
def test_refuses_a_device_that_cannot_be_opened_in_one_line(tmp_path: Path, name: str, message: str) -> None:
    (tmp_path / "file").touch()
    before = len(os.listdir("/proc/self/fd"))
    with pytest.raises(DriverError, match=message) as caught:
        V4l2Camera(V4l2Settings(str(tmp_path / name)), "lower")
    assert "\n" not in str(caught.value) and str(tmp_path / name) in str(caught.value)
    assert len(os.listdir("/proc/self/fd")) <= before
