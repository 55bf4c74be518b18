"""The modes of a capture device (format, size, rate) and the choice of a format."""

from __future__ import annotations

import pytest

from drivers.cameras.v4l2_modes import Mode, SizeRange, choose_format
from drivers.errors import DriverError

WEBCAM = [
    Mode("YUYV", SizeRange(640, 640), SizeRange(480, 480), (30.0, 15.0)),
    Mode("YUYV", SizeRange(1280, 1280), SizeRange(960, 960), (7.5, 5.0)),
    Mode("MJPG", SizeRange(1280, 1280), SizeRange(960, 960), (30.0, 15.0)),
    Mode("H264", SizeRange(1280, 1280), SizeRange(960, 960), (60.0,)),
]


@pytest.mark.parametrize(
    ("size", "rate_hz", "chosen"),
    [((640, 480), 30, "YUYV"), ((1280, 960), 30, "MJPG"), ((1280, 960), 5, "YUYV"), ((1280, 960), 0, "YUYV"),
     ((1280, 960), 30.1, "MJPG")],
)  # fmt: skip
def test_auto_prefers_a_format_without_decoding_if_it_is_fast_enough(
    size: tuple[int, int], rate_hz: float, chosen: str
) -> None:
    assert choose_format(WEBCAM, "auto", size, rate_hz) == chosen


def test_prefers_grey_and_accepts_unknown_rates() -> None:
    any_size = SizeRange(16, 4096, 16)
    offered = [Mode(name, any_size, any_size) for name in ("MJPG", "UYVY", "YUYV", "NV12", "GREY")]
    chosen = [choose_format(offered[:count], "auto", (640, 480), 90) for count in range(1, 6)]
    assert chosen == ["MJPG", "UYVY", "YUYV", "NV12", "GREY"]


@pytest.mark.parametrize(
    ("name", "size", "rate_hz"),
    [("GREY", (640, 480), 30), ("YUYV", (640, 481), 30), ("YUYV", (640, 480), 31), ("auto", (1280, 960), 60)],
)
def test_refuses_other_modes_and_lists_those_offered(name: str, size: tuple[int, int], rate_hz: float) -> None:
    with pytest.raises(DriverError, match=r"not offered; choose from: YUYV 640x480 at 30, 15 Hz; .*MJPG") as caught:
        choose_format(WEBCAM, name, size, rate_hz)
    assert "H264" not in str(caught.value) and "\n" not in str(caught.value)


def test_sizes_come_in_steps() -> None:
    assert 48 in SizeRange(16, 64, 16) and 50 not in SizeRange(16, 64, 16) and 80 not in SizeRange(16, 64, 16)
    assert 50 in SizeRange(16, 64, 0)
