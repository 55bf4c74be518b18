"""Cameras found in trees with the layout of /sys and /dev, and devices that cannot be opened."""

from __future__ import annotations

from pathlib import Path

import pytest

from drivers.cameras.v4l2_devices import CaptureDevice, capture_devices, describe_device, udev_rules
from drivers.cameras.v4l2_modes import Mode, SizeRange
from omnid.cli import main
from omnid.commands import cameras

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


def test_reports_why_a_device_cannot_be_queried(two_webcams: Path) -> None:
    (two_webcams / "dev/video10").unlink()
    first, second = capture_devices(two_webcams)
    assert "is not a video device" in first.problem and "is not there" in second.problem


def test_rules_match_the_ports(two_webcams: Path) -> None:
    rules = list(udev_rules(capture_devices(two_webcams)))
    expected = f'SUBSYSTEM=="video4linux", ATTR{{index}}=="0", ENV{{ID_PATH}}=="{PORT}", SYMLINK+="omnid/lower"'
    assert rules[0] == expected
    assert 'usb-0:2:1.0", SYMLINK+="omnid/upper"' in rules[1] and len(rules) == 2


def test_rules_distinguish_cameras_on_one_port_by_name(tmp_path: Path) -> None:
    for number in (0, 1):
        plug(tmp_path, f"video{number}", name=f"vivid-00{number}-vid-cap", port="platform-vivid.0")
    link(tmp_path, "by-path", "platform-vivid.0-video-index0", "video1")
    first, second = capture_devices(tmp_path)
    assert (first.by_path, second.by_path) == ("", "/dev/v4l/by-path/platform-vivid.0-video-index0")
    rules = list(udev_rules((first, second)))
    assert 'ENV{ID_PATH}=="platform-vivid.0", ATTR{name}=="vivid-000-vid-cap", SYMLINK+="omnid/lower"' in rules[0]
    assert 'ATTR{name}=="vivid-001-vid-cap"' in rules[1]


def test_description_has_a_line_for_each_format() -> None:
    one, any_of = Mode("YUYV", SizeRange(640, 640), SizeRange(480, 480), (30.0, 14.985)), SizeRange(16, 64)
    offered = (one, one, Mode("GREY", any_of, any_of))
    device = CaptureDevice("/dev/video0", "HD Webcam", "uvcvideo", "usb-0", "/by/path", "", "p", offered)
    assert list(describe_device(device)) == [
        "/dev/video0  HD Webcam  (uvcvideo, usb-0)", "  /by/path",
        "  YUYV 640x480 at 30, 14.98 Hz; 640x480 at 30, 14.98 Hz", "  GREY 16..64x16..64",
        "  no exposure time to set",
    ]  # fmt: skip
    can_be_set = CaptureDevice("/dev/video0", "", "", "", "", "", "", offered, exposure="exposure 1 to 20 ms")
    assert list(describe_device(can_be_set))[-1] == "  exposure 1 to 20 ms"


def test_the_command_lists_the_cameras(
    two_webcams: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(cameras, "ROOT", two_webcams)
    assert main(["cameras"]) == 0
    printed = capsys.readouterr().out
    assert "/dev/video2  HD Webcam" in printed and "/etc/udev/rules.d/" in printed and "omnid/upper" in printed


def test_without_a_camera_the_command_prints_one_line_and_exits_with_1(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(cameras, "ROOT", tmp_path)
    assert main(["cameras"]) == 1
    printed = capsys.readouterr()
    assert printed.out == "" and printed.err.startswith("omnid: no cameras") and printed.err.count("\n") == 1
