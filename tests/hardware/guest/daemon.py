"""Run by pytest in the guest, as root: `omnid run` under its unit, two loopback cameras, a motor at ttyS1.

The tests build on each other. The cameras show the sample log: each image again and again until the daemon has told
a pose of it, then the next, so that an emulated machine may take its time. All deadlines are long for the same reason.
"""

from __future__ import annotations

import json
import os
import shutil
import signal
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import serial  # type: ignore[import-untyped]
from numpy.typing import NDArray

from calib import se3
from drivers.cameras.log_camera import LogImages
from tests.hardware.guest.loopback import load_loopback
from tests.hardware.guest.unit import DROP_INS, SYSTEMD, restarted, run, said, show, until
from tests.hardware.guest.world import SAMPLE, Operator, World

RESULTS = Path("/mnt/job/results")
RECORDINGS = Path("/var/lib/omnid/recordings")
RULES = """SUBSYSTEM=="video4linux", KERNEL=="video10", SYMLINK+="omnid/lower"
SUBSYSTEM=="video4linux", KERNEL=="video11", SYMLINK+="omnid/upper"
SUBSYSTEM=="tty", KERNEL=="ttyS1", SYMLINK+="omnid/motor"
"""
PROGRAM = """#!/usr/bin/python3
import sys
sys.path.insert(0, "/opt/omnid")
from omnid.cli import main
sys.exit(main())
"""
SLOW = """[Service]
WatchdogSec=40
TimeoutStartSec=400
TimeoutStopSec=120
"""
SETTINGS = """
[cameras]
width_px = 512
height_px = 512
rate_hz = 0.0
pixel_format = "MJPG"
timeout_s = 8.0
[pair]
tolerance_ms = 1000.0
[panorama]
width_px = 512
[odometry.limits]
features = 200
max_gap_s = 60.0
[motor]
port = "/dev/omnid/motor"
rate_hz = 2.0
watchdog_ms = 5000
[controller.deadlines]
pose_s = 10.0
command_s = 5.0
tick_s = 5.0
[live]
status_s = 2.0
cloud_s = 0.0
[record]
enabled = true
free_mb = 10
[realtime]
longest_run_ms = 10000
[service]
stall_timeout_s = 30.0
"""


class Wheels:
    """The controller outside, by the line on which it answers questions."""

    def __init__(self) -> None:
        self._port = serial.Serial("/dev/ttyS2", 115200, timeout=30)
        self.log: list[dict[str, Any]] = []

    def ask(self) -> dict[str, Any]:
        """Its state now, and the fastest that a wheel was told since the last question."""
        self._port.write(b"?\n")
        self.log.append(json.loads(self._port.readline()))
        return self.log[-1]

    @property
    def commanded_mps(self) -> float:
        """What they are told now, or were told last."""
        return float(self.ask()["commanded_mps"])


def transform_of(row: NDArray[np.float64]) -> NDArray[np.float64]:
    """T_world_rig out of x y z and a quaternion x y z w."""
    return se3.transform(se3.rotation(row[3:]), row[:3])


def words() -> list[str]:
    """What the journal has of the unit."""
    return [text for _, text in said()]


@pytest.fixture(scope="module", autouse=True)
def unit() -> Iterator[None]:
    """omnid as the README installs it."""
    load_loopback()
    run("busybox", "ip", "link", "set", "lo", "up")
    run("useradd", "--system", "--no-create-home", "--shell", "/usr/sbin/nologin", "omnid")
    run("python3", "-m", "compileall", "-q", "/opt/omnid/omnid", "/opt/omnid/drivers", "/opt/omnid/calib")
    run("chmod", "-R", "a+rX", "/opt/omnid")
    for path, text in ((Path("/opt/omnid/bin/omnid"), PROGRAM), (Path("/etc/omnid/omnid.toml"), SETTINGS),
                       (DROP_INS / "slow.conf", SLOW), (Path("/etc/udev/rules.d/90-omnid.rules"), RULES)):
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text)
    Path("/opt/omnid/bin/omnid").chmod(0o755)
    shutil.copy("/mnt/job/rig.toml", "/etc/omnid")
    shutil.copy(SYSTEMD / "omnid.service", DROP_INS.parent)
    run("udevadm", "control", "--reload")
    run("udevadm", "trigger", "--settle", "--subsystem-match=video4linux", "--subsystem-match=tty")
    run("systemctl", "daemon-reload")
    yield
    (RESULTS / "journal").write_text("\n".join(words()))


@pytest.fixture(scope="module")
def world(unit: None) -> World:
    return World()


@pytest.fixture(scope="module")
def operator(world: World) -> Iterator[Operator]:
    run("systemctl", "start", "omnid")  # waits for READY=1
    made = Operator(world)
    yield made
    made.close()


@pytest.fixture(scope="module")
def wheels() -> Wheels:
    return Wheels()


def test_poses_flow_once_it_is_ready(operator: Operator) -> None:
    assert show("ActiveState") == "active"
    assert {pose.state for pose in operator.more(8)} == {"tracking"}


def test_they_are_those_of_the_log(operator: Operator) -> None:
    truth = np.loadtxt(SAMPLE / "truth.txt")  # TUM: time, x y z, quaternion; T_base_rig of this rig is 1
    first = operator.poses[0]
    until(lambda: operator.index(operator.poses[-1]) >= operator.index(first) + 10)
    last = operator.poses[-1]
    of_first, of_last = (truth[operator.index(pose), 1:] for pose in (first, last))
    moved = se3.inverse(first.T_odom_base) @ last.T_odom_base
    expected = se3.inverse(transform_of(of_first)) @ transform_of(of_last)
    assert np.linalg.norm(expected[:3, 3]) > 0.4
    assert np.linalg.norm(moved[:3, 3] - expected[:3, 3]) < 0.05


def test_commands_turn_the_wheels_and_silence_stops_them(operator: Operator, wheels: Wheels) -> None:
    until(lambda: wheels.ask()["commands"] > 3)
    before = wheels.ask()
    assert before["fastest_mps"] == 0.0
    operator.driving = True
    until(lambda: wheels.commanded_mps > 0.25)
    operator.driving = False
    until(lambda: wheels.commanded_mps == 0.0)
    after = wheels.ask()
    assert after["errors"] == before["errors"] and after["way_m"] > 0.05
    assert "the wheels stop: the command is stale" in words()


def test_one_camera_gone_stops_the_wheels_until_it_is_back(world: World, operator: Operator, wheels: Wheels) -> None:
    operator.driving = True
    until(lambda: wheels.commanded_mps > 0.25)
    world.close("lower")
    until(lambda: wheels.commanded_mps == 0.0)
    until(lambda: operator.message("lower camera").startswith("camera /dev/omnid/lower"))
    until(lambda: operator.message("pairing") == "no images of the lower camera")
    assert wheels.ask()["fastest_mps"] == 0.0
    world.open("lower")
    operator.more(3)
    until(lambda: wheels.commanded_mps > 0.25)
    lost = [text for text in words() if "lower camera: " in text]
    assert sum("lost, and tried again" in text for text in lost) == 1 and sum(": back, " in text for text in lost) == 1
    assert show("NRestarts") == "0"


def test_a_kill_stops_the_wheels_until_it_is_back(world: World, operator: Operator, wheels: Wheels) -> None:
    pid, before = int(show("MainPID")), wheels.ask()
    os.kill(pid, signal.SIGKILL)
    killed_ns = time.time_ns()
    until(lambda: wheels.commanded_mps == 0.0)
    after = wheels.ask()
    assert after["expiries"] == before["expiries"], "what steers slowed them down, long before the watchdog"
    keep_what_was_recorded(killed_ns, killed_ns - operator.poses[-1].stamp_ns)
    until(lambda: int(show("MainPID")) not in (0, pid))
    assert wheels.ask()["fastest_mps"] == 0.0
    restarted(pid)
    operator.more(3)
    until(lambda: wheels.commanded_mps > 0.25)
    assert wheels.ask()["unsafe_resumes"] == 0


def keep_what_was_recorded(killed_ns: int, newest_age_ns: int) -> None:
    """For those outside, who are faster."""
    left, = RECORDINGS.glob("*.part")
    shutil.copy(left, RESULTS / "killed.mcap.part")
    (RESULTS / "killed.json").write_text(json.dumps({"killed_ns": killed_ns, "newest_age_ns": newest_age_ns}))


def test_a_daemon_that_stands_still_is_started_anew(operator: Operator, wheels: Wheels) -> None:
    pid = int(show("MainPID"))
    os.kill(pid, signal.SIGSTOP)
    until(lambda: wheels.commanded_mps == 0.0)
    restarted(pid)
    lines = words()
    assert any("Watchdog timeout" in text for text in lines)
    assert any("Fatal Python error: Aborted" in text for text in lines)
    operator.more(3)
    until(lambda: wheels.commanded_mps > 0.25)


def test_the_end_stops_the_wheels(operator: Operator, wheels: Wheels) -> None:
    before = wheels.ask()
    run("systemctl", "stop", "--no-block", "omnid")
    until(lambda: wheels.commanded_mps == 0.0)
    assert wheels.ask()["expiries"] == before["expiries"], "told so, long before its watchdog"
    run("systemctl", "stop", "omnid")
    after = wheels.ask()
    assert after["commanded_mps"] == after["fastest_mps"] == 0.0
    assert (show("ActiveState"), show("Result"), show("ExecMainStatus")) == ("inactive", "success", "0")
    assert after["unsafe_resumes"] == 0 and not any("Traceback" in text for text in words())


def test_what_is_recorded_from_the_cameras_alone_is_a_log(operator: Operator, tmp_path: Path) -> None:
    """`omnid record` beside no daemon, ended as Ctrl-C does."""
    run("timeout", "--preserve-status", "-s", "INT", "60", "/opt/omnid/bin/omnid", "record", str(tmp_path / "boards"),
        "--config", "/etc/omnid/omnid.toml")
    log, = (tmp_path / "boards").glob("*.mcap")
    assert "rig.toml" in run("/opt/omnid/bin/omnid", "log", "info", str(log))
    images = LogImages.load(log)
    for eye in (images.lower, images.upper):
        stamps_ns = [frame.stamp_ns for _, frame in eye]
        assert len(stamps_ns) > 10 and stamps_ns == sorted(set(stamps_ns))
        assert {frame.encoding for _, frame in eye} == {"jpeg"}
