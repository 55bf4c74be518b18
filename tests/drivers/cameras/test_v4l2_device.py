"""Cameras found in trees with the layout of /sys and /dev, the choice of a format, and errors with advice."""

from __future__ import annotations

import errno
import os
from pathlib import Path
from typing import Any

import pytest

from drivers.cameras import v4l2_ioctl as v4l2
from drivers.cameras.v4l2_device import (
    capture_devices,
    device_error,
    offered_image,
    udev_rules,
)
from drivers.cameras.v4l2_settings import V4l2Settings
from drivers.errors import DriverError
from omnid.cli import main
from omnid.commands import machine
from tests.drivers.cameras.fake_camera import FakeCamera

PORT = "pci-0000:00:14.0-usb-0:1:1.0"


def plug(root: Path, node: str, *, name: str, port: str, index: int = 0) -> None:
    """Create the entries of a camera as the kernel does; its device is an ordinary file."""
    device = root / "sys/devices" / port
    device.mkdir(parents=True, exist_ok=True)
    (root / "sys/bus/usb/drivers/uvcvideo").mkdir(parents=True, exist_ok=True)
    if not (device / "driver").is_symlink():
        (device / "driver").symlink_to(root / "sys/bus/usb/drivers/uvcvideo")
    entry = root / "sys/class/video4linux" / node
    entry.mkdir(parents=True)
    (entry / "name").write_text(f"{name}\n")
    (entry / "index").write_text(f"{index}\n")
    (entry / "device").symlink_to(device)
    (root / "dev").mkdir(exist_ok=True)
    (root / "dev" / node).touch()


def link(root: Path, folder: str, name: str, node: str) -> None:
    (root / "dev/v4l" / folder).mkdir(parents=True, exist_ok=True)
    (root / "dev/v4l" / folder / name).symlink_to(f"../../{node}")


@pytest.fixture
def two_webcams(tmp_path: Path) -> Path:
    """Two cameras of one model, each with a metadata node, and the links of a newer udev, two for a port."""
    for number, port in ((2, PORT), (10, PORT.replace("0:1:", "0:2:"))):
        plug(tmp_path, f"video{number}", name="HD Webcam", port=port)
        plug(tmp_path, f"video{number + 1}", name="HD Webcam", port=port, index=1)
        link(tmp_path, "by-path", f"{port.replace('-usb-', '-usbv2-')}-video-index0", f"video{number}")
        link(tmp_path, "by-path", f"{port}-video-index0", f"video{number}")
        link(tmp_path, "by-path", f"{port}-video-index1", f"video{number + 1}")
    link(tmp_path, "by-id", "usb-Maker_HD_Webcam-video-index0", "video10")
    return tmp_path


def test_finds_cameras_by_number_without_metadata_nodes(two_webcams: Path) -> None:
    found = capture_devices(two_webcams)
    assert [(device.node, device.name, device.driver) for device in found] == [
        ("/dev/video2", "HD Webcam", "uvcvideo"), ("/dev/video10", "HD Webcam", "uvcvideo"),
    ]  # fmt: skip
    assert found[0].by_path == f"/dev/v4l/by-path/{PORT}-video-index0" and found[0].by_id == ""
    assert found[1].by_id == "/dev/v4l/by-id/usb-Maker_HD_Webcam-video-index0"
    (two_webcams / "dev/video10").unlink()
    first, second = capture_devices(two_webcams)
    assert "is not a video device" in first.problem and "is not there" in second.problem


def test_rules_match_the_ports_and_on_one_port_the_names(two_webcams: Path) -> None:
    rules = list(udev_rules(capture_devices(two_webcams)))
    expected = f'SUBSYSTEM=="video4linux", ATTR{{index}}=="0", ENV{{ID_PATH}}=="{PORT}", SYMLINK+="omnid/lower"'
    assert rules[0] == expected
    assert 'usb-0:2:1.0", SYMLINK+="omnid/upper"' in rules[1] and len(rules) == 2
    root = two_webcams / "vivid"
    for number in (0, 1):
        plug(root, f"video{number}", name=f"vivid-00{number}-vid-cap", port="platform-vivid.0")
    link(root, "by-path", "platform-vivid.0-video-index0", "video1")
    first, second = capture_devices(root)
    assert (first.by_path, second.by_path) == ("", "/dev/v4l/by-path/platform-vivid.0-video-index0")
    rules = list(udev_rules((first, second)))
    assert 'ENV{ID_PATH}=="platform-vivid.0", ATTR{name}=="vivid-000-vid-cap", SYMLINK+="omnid/lower"' in rules[0]
    assert 'ATTR{name}=="vivid-001-vid-cap"' in rules[1]


def test_the_command_lists_the_cameras(
    two_webcams: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(machine, "ROOT", two_webcams)
    monkeypatch.setattr(v4l2, "call", FakeCamera().call)
    assert main(["cameras"]) == 0
    printed = capsys.readouterr().out
    assert "/dev/video2  HD Webcam  (uvcvideo, usb-1)" in printed and "  exposure 0.3 to 204.7 ms" in printed
    assert "v4l2-ctl -d /dev/video2 --list-formats-ext" in printed
    assert "/etc/udev/rules.d/" in printed and "omnid/upper" in printed
    monkeypatch.setattr(machine, "ROOT", two_webcams / "none")
    assert main(["cameras"]) == 1
    missing = capsys.readouterr()
    assert missing.out == "" and missing.err.startswith("omnid: no cameras") and missing.err.count("\n") == 1


def image(camera: FakeCamera, path: Path, **fields: Any) -> str:
    """Return the image that a camera gives with these settings."""
    path.touch()
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(v4l2, "call", camera.call)
        return str(offered_image(V4l2Settings(str(path), **fields)))


@pytest.mark.parametrize(
    ("fields", "expected"),
    [
        ({"width_px": 640, "height_px": 480}, "YUYV 640x480 at 30 Hz"),
        ({"rate_hz": 30.1}, "MJPG 1280x960 at 30 Hz"),
        ({"rate_hz": 5.0}, "YUYV 1280x960 at 5 Hz"),
        ({"rate_hz": 0.0}, "YUYV 1280x960 at 7.5 Hz"),
        ({"pixel_format": "MJPG"}, "MJPG 1280x960 at 30 Hz"),
    ],
)
def test_auto_prefers_a_format_without_decoding_if_it_is_fast_enough(
    tmp_path: Path, fields: dict[str, Any], expected: str
) -> None:
    assert image(FakeCamera(), tmp_path / "video", **fields) == expected


@pytest.mark.parametrize(
    ("fields", "message"),
    [
        ({"pixel_format": "GREY", "width_px": 640, "height_px": 480}, "GREY 640x480 at 30 Hz is not offered; .* YUYV"),
        ({"pixel_format": "YUYV", "height_px": 481}, "the device sets YUYV 640x480 at 30 Hz instead"),
        ({"rate_hz": 60.0}, r"auto 1280x960 at 60 Hz is not offered; .*MJPG 1280x960 at 30 Hz"),
    ],
)
def test_refuses_other_modes_and_names_what_the_device_sets(
    tmp_path: Path, fields: dict[str, Any], message: str
) -> None:
    with pytest.raises(DriverError, match=message) as caught:
        image(FakeCamera(), tmp_path / "video", **fields)
    assert "--list-formats-ext" in str(caught.value) and "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("number", "advice"),
    [(errno.EBUSY, "used by another program"), (errno.ENOSPC, "choose MJPG"), (errno.EIO, "Input/output error")],
)
def test_errors_of_the_system_have_advice(number: int, advice: str) -> None:
    message = str(device_error("/dev/video0", OSError(number, os.strerror(number))))
    assert message.startswith("camera /dev/video0 ") and advice in message and "\n" not in message


@pytest.mark.parametrize(
    ("device", "fields"),
    [
        ("0", {}),
        *(("/dev/omnid/lower", {"controls": (text,)}) for text in ("gain", "gain=high", "=3")),
        ("/dev/omnid/lower", {"auto_gain": "on", "gain": 3}),
        ("/dev/omnid/lower", {"auto_exposure": "on", "exposure_us": 100}),
    ],
)
def test_refuses_settings_that_contradict_each_other_in_one_line(device: str, fields: dict[str, Any]) -> None:
    with pytest.raises(DriverError, match=rf"^camera {device}: .*give ") as caught:
        V4l2Settings(device, **fields)
    assert "\n" not in str(caught.value)
