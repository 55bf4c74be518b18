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

from calib.rig_file import read_rig, write_rig
from drivers.cameras.v4l2_device import CaptureDevice, StreamFormat
from drivers.cameras.v4l2_settings import V4l2Settings
from drivers.errors import DriverError
from omnid.cli import main
from omnid.config import RecordConfig
from omnid.controller.motor_settings import MotorSettings
from omnid.doctor import checks
from omnid.doctor.checks import Finding, access, bus, cameras, disk, motor, rig
from omnid.transport.bus_config import BusConfig

ROOT = Path(__file__).parents[3]
UNPRIVILEGED = 65534
IMAGE = StreamFormat("MJPG", 1280, 960, 0, 30.0)


@contextmanager
def opened_elsewhere(path: Path | str) -> Iterator[None]:
    """Another process has the file open."""
    hold = "import sys; file = open(sys.argv[1], 'rb', buffering=0); print('here', flush=True); sys.stdin.read()"
    with subprocess.Popen([sys.executable, "-c", hold, str(path)], stdin=subprocess.PIPE, stdout=subprocess.PIPE) as it:
        assert it.stdout is not None and it.stdout.readline() == b"here\n"
        yield
        it.communicate()


class Robot:
    """A tree like /dev with two cameras and their persistent names."""

    def __init__(self, root: Path) -> None:
        self.root = root
        (root / "dev/omnid").mkdir(parents=True)
        self.known = []
        for number, name in ((0, "lower"), (2, "upper")):
            node = root / f"dev/video{number}"
            node.touch()
            node.chmod(0o666)
            (root / f"dev/omnid/{name}").symlink_to(node)
            self.known.append(CaptureDevice(f"/dev/video{number}", "HD Webcam", "uvcvideo", "usb", "", "", ""))

    def examined(self, lower: str = "/dev/omnid/lower", **how: str) -> list[Finding]:
        """Return the findings for both cameras with these settings."""
        wanted = {"lower": V4l2Settings(lower, **how), "upper": V4l2Settings("/dev/omnid/upper", **how)}  # type: ignore[arg-type]
        return list(cameras(wanted, self.known, self.root))


@pytest.fixture
def robot(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Robot:
    monkeypatch.setattr(checks, "offered_image", lambda _: IMAGE)
    return Robot(tmp_path)


def test_accepts_cameras_with_the_configured_image(robot: Robot, monkeypatch: pytest.MonkeyPatch) -> None:
    first, second = robot.examined()
    assert str(first) == "ok       camera lower  HD Webcam at /dev/video0, MJPG 1280x960 at 30 Hz"
    assert second.level == "ok" and "/dev/video2" in second.found
    assert robot.examined(auto_exposure="rig")[0].found.endswith("30 Hz, exposure left to it")
    robot.known = [replace(device, exposure="exposure 1 to 9 ms") for device in robot.known]
    assert robot.examined(auto_exposure="rig")[0].found.endswith("30 Hz, exposure 1 to 9 ms set by omnid run")
    monkeypatch.setattr(checks, "offered_image", lambda _: None)
    assert "in use, so that its image was not tried" in robot.examined()[0].found


def test_finds_faults_of_cameras(robot: Robot, monkeypatch: pytest.MonkeyPatch) -> None:
    (missing, right) = robot.examined(lower="/dev/omnid/lowest")
    assert missing.level == "error" and "/dev/omnid/lowest does not exist" in missing.found
    assert "omnid cameras" in missing.advice and right.level == "ok"
    (robot.root / "dev/null").touch()
    assert "is no camera" in robot.examined(lower="/dev/null")[0].found
    assert robot.examined(lower="/dev/video2")[-1].found == "both names lead to one device"
    robot.known[0] = replace(robot.known[0], problem="is broken; mend it")
    assert "is broken" in str(robot.examined()[0]) and robot.examined()[0].level == "error"
    (robot.root / "proc").symlink_to("/proc")
    with opened_elsewhere(robot.root / "dev/video2"):
        assert "is open in python" in robot.examined()[1].found
    assert robot.examined()[1].level == "ok"

    def refuse(_: V4l2Settings) -> StreamFormat:
        raise DriverError("auto 1280x960 at 60 Hz is not offered")

    monkeypatch.setattr(checks, "offered_image", refuse)
    assert robot.examined()[1].level == "error" and "[cameras]" in robot.examined()[1].advice


@pytest.fixture
def port() -> Iterator[str]:
    """A pseudo-terminal as a serial port."""
    controller, own = os.openpty()
    yield os.ttyname(own)
    os.close(own)
    os.close(controller)


def test_checks_the_port_of_the_motor(port: str) -> None:
    settings = MotorSettings(port)
    os.chmod(port, 0o666)
    assert [str(finding) for finding in motor(settings)] == [f"ok       motor         line on {port}"]
    with opened_elsewhere(port):
        (found,) = motor(settings)
    assert found.level == "error" and "in use by python" in found.found
    os.chmod(port, 0o660)
    group = grp.getgrgid(os.stat(port).st_gid).gr_name
    (found,) = motor(settings)
    assert found.level == "warning" and f"of group {group}" in found.found and 'GROUP="dialout"' in found.advice


def as_another_user(script: str) -> list[str]:
    """Return the lines that a script prints as a user without rights."""
    text = f"import os, resource; from pathlib import Path\n{script.format(user=UNPRIVILEGED)}"
    done = subprocess.run([sys.executable, "-c", text], cwd=ROOT, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    return done.stdout.splitlines()


@pytest.mark.skipif(os.geteuid() != 0, reason="only root can give a file to group video")
def test_finds_a_device_without_permission() -> None:
    with tempfile.NamedTemporaryFile(prefix="omnid-doctor-") as file:
        device = Path(file.name)
        device.chmod(0)
        os.chown(device, -1, grp.getgrnam("video").gr_gid)
        (line,) = as_another_user(
            "from omnid.doctor.checks import access\nos.setuid({user})\n" + f"print(*access('motor', Path('{device}')))"
        )
        assert "no permission" in line and "usermod" in line
        device.chmod(0o660)
        assert list(access("motor", device)) == []


def test_checks_the_rights_of_this_user() -> None:
    lines = as_another_user(
        "from omnid.doctor.checks import rights\n"
        "for kind in (resource.RLIMIT_RTPRIO, resource.RLIMIT_MEMLOCK): resource.setrlimit(kind, (0, 0))\n"
        "os.getuid() or os.setuid({user})\n"
        "print(*rights(20, True), *rights(0, False), sep='\\n')"
    )
    assert [line.split()[0] for line in lines] == ["warning", "warning", "ok", "ok"]
    assert "LimitRTPRIO=20" in lines[0] and "LimitMEMLOCK=infinity" in lines[1]


def test_checks_the_space_for_recordings(tmp_path: Path) -> None:
    (found,) = disk(checks.STATE / "not" / "yet", RecordConfig(keep_mb=360, free_mb=0), 1e5)
    assert found.level == "ok" and f"free at {checks.STATE.parent}" in found.found and "some 1.0 h" in found.found
    for enabled, level in ((False, "warning"), (True, "error")):
        (found,) = disk(checks.STATE, RecordConfig(enabled=enabled, free_mb=10**9), 1e6)
        assert found.level == level and "record.free_mb = 1000000000" in found.found
    *_, found = disk(tmp_path, RecordConfig(free_mb=0), 1e6)
    assert found.level == "warning" and f"ReadWritePaths={tmp_path}" in found.advice
    unit = (ROOT / "systemd" / "omnid.service").read_text()
    assert f"\nWorkingDirectory={checks.STATE}\n" in unit and f"\nStateDirectory={checks.STATE.name}\n" in unit


def test_checks_the_rig(scene: Path, tmp_path: Path) -> None:
    size = read_rig(scene / "rig.toml").lower.camera.size
    assert all(finding.level != "error" for finding in rig(scene / "rig.toml", size))
    wrong = [finding for finding in rig(scene / "rig.toml", (1280, 960)) if finding.level == "error"]
    assert len(wrong) == 2 and "256x256" in wrong[0].found and "asks for 1280x960" in wrong[0].found
    found = list(rig(scene / "rig.toml", size))
    assert any(one.level == "warning" and "does not state the height" in one.found for one in found)
    assert not any("does not state" in one.found for one in rig(scene / "rig.toml", size, -1.2))
    whole = read_rig(scene / "rig.toml").at_height(1.2)
    write_rig(tmp_path / "masked.toml", whole)
    bare = replace(whole, lower=replace(whole.lower, mask=None), upper=replace(whole.upper, mask=None))
    write_rig(tmp_path / "bare.toml", bare)
    (masked,) = rig(tmp_path / "masked.toml", size)
    assert masked.level == "ok" and "between the viewpoints, 1.200 m above the floor" in masked.found
    (without,) = rig(tmp_path / "bare.toml", size)
    assert without.level == "warning" and "no mask for lower and upper" in without.found
    for text in (None, "", "nonsense = [", "schema = 99"):
        if text is not None:
            (tmp_path / "rig.toml").write_text(text)
        (unread,) = rig(tmp_path / "rig.toml", size)
        assert unread.level == "error" and ("omnid calibrate" in unread.found) != ("omnid calibrate" in unread.advice)


@pytest.mark.parametrize(
    ("endpoint", "local"),
    [
        ("tcp/127.0.0.1:7447", True),
        ("tcp/[::1]:7447", True),
        ("tcp/localhost:7447", True),
        ("unixsock-stream//run/x", True),
        ("tcp/0.0.0.0:7447", False),
        ("tcp/[::]:7447", False),
        ("tcp/192.168.1.2:7447", False),
        ("udp/robot.local:7447", False),
    ],
)
def test_warns_of_open_endpoints_without_rules(endpoint: str, local: bool) -> None:
    for config in (BusConfig(listen=(endpoint,)), BusConfig(connect=(endpoint,))):
        found = bus(config)
        assert (found.level == "ok") == local and local != ("bus.config" in found.advice)


def test_the_command_runs_all_checks_and_returns_an_exit_code(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    missing = f"cameras.rig={tmp_path / 'rig.toml'}"
    assert main(["doctor", "--set", missing]) == 1
    *lines, last = capsys.readouterr().out.splitlines()
    assert {line[:9].strip() for line in lines} <= {"ok", "warning", "error"}
    subjects = "camera lower,camera upper,rig,motor,real time,memory,compiled code,disk,bus"
    assert set(subjects.split(",")) <= {line[9:22].strip() for line in lines} and " errors, " in last
    assert main(["doctor", "--set", missing, "--json"]) == 1
    assert {found["level"] for found in json.loads(capsys.readouterr().out)} <= {"ok", "warning", "error"}
    assert main(["doctor", "--set", "cameras.widht_px=3"]) == 2
    assert "cameras.width_px" in capsys.readouterr().err
