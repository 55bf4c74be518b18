"""Checks of the cameras."""

from __future__ import annotations

import pytest

from omnid.doctor.cameras import CameraStream, buses


@pytest.mark.parametrize(
    ("streams", "level", "words"),
    [
        (
            [CameraStream("lower", "YUYV", 147.5, "1", 480), CameraStream("upper", "YUYV", 147.5, "1", 480)],
            "ok",
            "295 of 384",
        ),
        (
            [CameraStream("lower", "YUYV", 195, "1", 480), CameraStream("upper", "YUYV", 195, "1", 480)],
            "error",
            "390 Mbit/s over",
        ),
        (
            [CameraStream("lower", "YUYV", 590, "1", 480), CameraStream("upper", "GREY", 9, "1", 480)],
            "error",
            "would send 590",
        ),
        (
            [CameraStream("lower", "MJPG", 0, "1", 480), CameraStream("upper", "MJPG", 0, "1", 480)],
            "warning",
            "share a USB 2 bus",
        ),
        (
            [CameraStream("lower", "YUYV", 590, "2", 5000), CameraStream("upper", "YUYV", 590, "2", 5000)],
            "ok",
            "5000 Mbit/s",
        ),
        ([CameraStream("lower", "GREY", 900, "", 0), CameraStream("upper", "GREY", 900, "", 0)], "ok", "not on USB"),
        ([CameraStream("lower", "MJPG", 0, "1", 480)], "ok", "480 Mbit/s"),
    ],
)
def test_checks_the_bandwidth_of_usb(streams: list[CameraStream], level: str, words: str) -> None:
    (found,) = buses(streams)
    assert found.level == level and words in found.found
    assert (found.level == "ok") == (not found.advice)


def test_checks_each_bus_alone() -> None:
    streams = [CameraStream("lower", "YUYV", 195, "1", 480), CameraStream("upper", "YUYV", 195, "3", 480)]
    found = [(finding.level, finding.subject) for finding in buses(streams)]
    assert found == [("ok", "usb bus 1"), ("ok", "usb bus 3")]
