"""The doctor: each check finds its faults, with advice, and is ok otherwise."""

from __future__ import annotations

import grp
import json
import os
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

import pytest

from drivers.cameras.v4l2_devices import CaptureDevice
from drivers.cameras.v4l2_modes import Mode, SizeRange
from drivers.cameras.v4l2_settings import V4l2Settings
from omnid.cli import main
from omnid.doctor.cameras import cameras
from omnid.doctor.devices import access
from omnid.doctor.finding import Finding
from omnid.doctor.wiring import bus, motor
from omnid.transport.bus_config import BusConfig

ROOT = Path(__file__).parents[3]
UNPRIVILEGED = 65534
FORMATS = (
    Mode("YUYV", SizeRange(640, 640), SizeRange(480, 480), (30.0,)),
    Mode("MJPG", SizeRange(1280, 1280), SizeRange(960, 960), (30.0, 15.0)),
)


class Robot:
    """A tree like /sys and /dev with two cameras and their properties."""

    def __init__(self, root: Path) -> None:
        self.root = root
        self.known = [self._plug(number) for number in (0, 2)]

    def _plug(self, number: int) -> CaptureDevice:
        port = self.root / f"sys/devices/usb{number}/1-{number}/1-{number}:1.0"
        port.mkdir(parents=True)
        (port.parent / "busnum").write_text("1\n")
        (port.parent / "speed").write_text("480\n")
        entry = self.root / f"sys/class/video4linux/video{number}"
        entry.mkdir(parents=True)
        (entry / "device").symlink_to(port)
        node = self.root / f"dev/video{number}"
        (self.root / "dev/omnid").mkdir(parents=True, exist_ok=True)
        node.touch()
        node.chmod(0o666)
        (self.root / f"dev/omnid/{'upper' if number else 'lower'}").symlink_to(node)
        return CaptureDevice(f"/dev/video{number}", "HD Webcam", "uvcvideo", "usb", "", "", "", FORMATS)

    def examined(self, lower: str = "/dev/omnid/lower", **how: int | str | float) -> list[Finding]:
        """Return the findings for both cameras with these settings."""
        wanted = {
            name: V4l2Settings(device, **{"width_px": 1280, "height_px": 960, **how})  # type: ignore[arg-type]
            for name, device in (("lower", lower), ("upper", "/dev/omnid/upper"))
        }
        return list(cameras(wanted, self.known, self.root))


@pytest.fixture
def robot(tmp_path: Path) -> Robot:
    return Robot(tmp_path)


def levels(findings: list[Finding]) -> list[str]:
    return [finding.level for finding in findings]


@contextmanager
def opened_elsewhere(path: Path | str) -> Iterator[None]:
    """Another process has the file open."""
    hold = "import sys; file = open(sys.argv[1], 'rb', buffering=0); print('here', flush=True); sys.stdin.read()"
    with subprocess.Popen([sys.executable, "-c", hold, str(path)], stdin=subprocess.PIPE, stdout=subprocess.PIPE) as it:
        assert it.stdout is not None and it.stdout.readline() == b"here\n"
        yield
        it.communicate()


def test_accepts_cameras_with_the_configured_mode(robot: Robot) -> None:
    first, second, usb = robot.examined(pixel_format="YUYV", width_px=640, height_px=480)
    assert str(first) == "ok       camera lower  HD Webcam at /dev/video0, YUYV 640x480 at 30 Hz"
    assert second.level == "ok" and "/dev/video2" in second.found
    assert (usb.level, usb.subject) == ("ok", "usb bus 1") and "295 of 384 Mbit/s" in usb.found


def test_tells_whether_a_run_can_set_the_exposure(robot: Robot) -> None:
    mode: dict[str, str | int] = {"pixel_format": "YUYV", "width_px": 640, "height_px": 480, "auto_exposure": "rig"}
    assert robot.examined(**mode)[0].found.endswith("30 Hz, exposure left to it: it cannot be set")
    robot.known = [replace(device, exposure="exposure 1 to 9 ms") for device in robot.known]
    assert robot.examined(**mode)[0].found.endswith("30 Hz, exposure 1 to 9 ms set by omnid run")


def test_finds_a_mode_that_is_not_offered(robot: Robot) -> None:
    found = robot.examined(rate_hz=60.0)
    assert levels(found) == ["error", "error"] and "MJPG 1280x960 at 30, 15 Hz" in found[0].found
    assert "[cameras]" in found[0].advice


def test_finds_a_missing_camera(robot: Robot) -> None:
    found = robot.examined(lower="/dev/omnid/lowest")
    assert found[0].level == "error" and "/dev/omnid/lowest does not exist" in found[0].found
    assert "omnid cameras" in found[0].advice and found[1].level == "ok"


def test_finds_a_device_that_is_no_camera(robot: Robot) -> None:
    (robot.root / "dev/null").touch()
    assert "is no camera" in robot.examined(lower="/dev/null")[0].found


def test_finds_a_camera_that_cannot_be_queried(robot: Robot) -> None:
    robot.known[0] = CaptureDevice("/dev/video0", "", "", "", "", "", "", (), "is broken; mend it")
    assert "is broken" in str(robot.examined()[0]) and robot.examined()[0].level == "error"


def test_finds_one_device_for_both_cameras(robot: Robot) -> None:
    assert any("lead to one device" in finding.found for finding in robot.examined(lower="/dev/video2"))


def test_finds_a_camera_open_in_another_process(robot: Robot) -> None:
    (robot.root / "proc").symlink_to("/proc")
    with opened_elsewhere(robot.root / "dev/video0"):
        assert "is open in python" in robot.examined()[0].found
    assert robot.examined()[0].level == "ok"


@pytest.fixture
def port() -> Iterator[str]:
    """A pseudo-terminal as a serial port."""
    controller, own = os.openpty()
    yield os.ttyname(own)
    os.close(own)
    os.close(controller)


def test_accepts_a_motor_port(port: str) -> None:
    os.chmod(port, 0o666)
    assert [str(finding) for finding in motor(port)] == [f"ok       motor         {port}"]


def test_finds_a_port_of_another_group(port: str) -> None:
    os.chmod(port, 0o660)
    group = grp.getgrgid(os.stat(port).st_gid).gr_name
    (found,) = motor(port)
    assert found.level == "warning" and f"of group {group}" in found.found and 'GROUP="dialout"' in found.advice


def test_finds_a_port_in_use(port: str) -> None:
    os.chmod(port, 0o666)
    with opened_elsewhere(port):
        (found,) = motor(port)
    assert found.level == "error" and "in use by python" in found.found
    assert levels(list(motor(port))) == ["ok"]


@pytest.mark.skipif(os.geteuid() != 0, reason="only root can give a file to group video")
def test_finds_a_device_without_permission() -> None:
    """As an unprivileged user, in a process of its own."""
    with tempfile.NamedTemporaryFile(prefix="omnid-doctor-") as file:
        _closed_then_open(Path(file.name))


def _closed_then_open(device: Path) -> None:
    device.chmod(0)
    os.chown(device, -1, grp.getgrnam("video").gr_gid)
    script = (
        f"import os, json; from pathlib import Path; from omnid.doctor.devices import access\n"
        f"os.getuid() or os.setuid({UNPRIVILEGED})\n"
        f"print(json.dumps([str(finding) for finding in access('motor', Path('{device}'))]))"
    )
    done = subprocess.run([sys.executable, "-c", script], cwd=ROOT, capture_output=True, text=True)
    assert "no permission" in json.loads(done.stdout)[0] and "usermod" in done.stdout, done.stderr
    device.chmod(0o660)
    assert list(access("motor", device)) == []


def test_checks_the_rights_of_this_user() -> None:
    script = (
        "import os, resource; from omnid.doctor.machine import rights\n"
        "for kind in (resource.RLIMIT_RTPRIO, resource.RLIMIT_MEMLOCK): resource.setrlimit(kind, (0, 0))\n"
        f"os.getuid() or os.setuid({UNPRIVILEGED})\n"
        "print(*rights(20, True), *rights(0, False), sep='\\n')"
    )
    done = subprocess.run([sys.executable, "-c", script], cwd=ROOT, capture_output=True, text=True)
    lines = done.stdout.splitlines()
    assert [line.split()[0] for line in lines] == ["warning", "warning", "ok", "ok"], done.stderr
    assert "LimitRTPRIO=20" in lines[0] and "LimitMEMLOCK=infinity" in lines[1]


def router(endpoint: str) -> list[Finding]:
    return [finding for finding in bus(BusConfig(connect=(endpoint,))) if finding.subject == "router"]


def test_the_command_runs_all_checks_and_returns_an_exit_code(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    missing = f"cameras.rig={tmp_path / 'rig.toml'}"
    assert main(["doctor", "--set", missing]) == 1
    *lines, last = capsys.readouterr().out.splitlines()
    assert {line[:9].strip() for line in lines} <= {"ok", "warning", "error"}
    for subject in (
        "camera lower",
        "camera upper",
        "rig",
        "motor",
        "groups",
        "real time",
        "memory",
        "clock",
        "disk",
        "router",
        "programs",
    ):
        assert any(line[9:].startswith(subject) for line in lines)
    assert " errors, " in last


def test_the_command_refuses_a_wrong_configuration(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["doctor", "--set", "cameras.widht_px=3"]) == 2
    assert "cameras.width_px" in capsys.readouterr().err
