"""Run by pytest in the guest, as root: `omnid run` under its unit, two loopback cameras, a motor at ttyS1.

The tests build on each other. The cameras show the sample log: each image is repeated until the daemon has published a
pose of it, since the emulated machine is slow. All deadlines are long for the same reason.
"""

from __future__ import annotations

import json
import os
import shutil
import signal
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import serial  # type: ignore[import-untyped]

from tests.hardware.guest.surroundings import (
    DROP_INS,
    SYSTEMD,
    GuestOperator,
    SampleLog,
    journal,
    load_loopback,
    run,
    show,
    until,
    wait_for_restart,
)

CURSOR = Path("/run/journal-of-the-tests")
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
FIFO, OTHER = os.SCHED_FIFO, os.SCHED_OTHER
SLOW = """[Service]
WatchdogSec=40
TimeoutStartSec=1200
TimeoutStopSec=120
"""
SETTINGS = """
[cameras]
width_px = 512
height_px = 512
rate_hz = 0.0
pixel_format = "MJPG"
[pair]
tolerance_ms = 1000.0
[panorama]
width_px = 512
[odometry.limits]
features = 200
max_gap_s = 60.0
[motor]
port = "/dev/omnid/motor"
rate_hz = 5.0
watchdog_ms = 5000
[controller]
arming = "automatic"
[controller.motion]
check = false
[controller.deadlines]
pose_s = 10.0
command_s = 5.0
tick_s = 5.0
[live]
status_s = 2.0
cloud_s = 0.0
[obstacles]
enabled = false
[service]
stall_timeout_s = 30.0
"""


class Wheels:
    """The simulated board on the host, by the serial line on which it reports its state."""

    def __init__(self) -> None:
        self._port = serial.Serial("/dev/ttyS2", 115200, timeout=30)
        self.log: list[dict[str, Any]] = []

    def state(self) -> dict[str, Any]:
        """Return its state, with the highest commanded speed of a wheel since the last call."""
        self._port.write(b"?\n")
        self.log.append(json.loads(self._port.readline()))
        return self.log[-1]

    @property
    def commanded_mps(self) -> float:
        """The last commanded speed."""
        return float(self.state()["commanded_mps"])


@pytest.fixture(scope="module", autouse=True)
def unit() -> None:
    """omnid as the README installs it."""
    load_loopback()
    run("busybox", "ip", "link", "set", "lo", "up")
    run("useradd", "--system", "--no-create-home", "--shell", "/usr/sbin/nologin", "omnid")
    run("python3", "-m", "compileall", "-q", "/opt/omnid/omnid", "/opt/omnid/drivers", "/opt/omnid/calib")
    run("chmod", "-R", "a+rX", "/opt/omnid")
    for path, text in (
        (Path("/opt/omnid/bin/omnid"), PROGRAM),
        (Path("/etc/omnid/omnid.toml"), SETTINGS),
        (DROP_INS / "slow.conf", SLOW),
        (Path("/etc/udev/rules.d/90-omnid.rules"), RULES),
    ):
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text)
    Path("/opt/omnid/bin/omnid").chmod(0o755)
    shutil.copy("/mnt/job/rig.toml", "/etc/omnid")
    shutil.copy(SYSTEMD / "omnid.service", DROP_INS.parent)
    run("udevadm", "control", "--reload")
    run("udevadm", "trigger", "--settle", "--subsystem-match=video4linux", "--subsystem-match=tty")
    run("systemctl", "daemon-reload")


@pytest.fixture(autouse=True)
def print_journal() -> Iterator[None]:
    """Print what each test added to the journal, which its failure then shows."""
    yield
    print(run("journalctl", "-u", "omnid", "--no-pager", "-o", "short-monotonic", f"--cursor-file={CURSOR}"))


@pytest.fixture(scope="module")
def sample_log(unit: None) -> SampleLog:
    return SampleLog()


@pytest.fixture(scope="module")
def operator(sample_log: SampleLog) -> Iterator[GuestOperator]:
    run("systemctl", "start", "omnid")  # waits for READY=1
    made = GuestOperator(sample_log)
    yield made
    made.close()


@pytest.fixture(scope="module")
def wheels() -> Wheels:
    return Wheels()


def test_poses_flow_once_the_service_is_ready(operator: GuestOperator) -> None:
    assert show("ActiveState") == "active"
    assert {pose.state for pose in operator.more(8)} == {"tracking"}


def test_memory_is_locked_and_only_three_threads_have_priority(operator: GuestOperator) -> None:
    group = Path("/sys/fs/cgroup" + show("ControlGroup"))
    threads = {}
    for process in (group / "cgroup.procs").read_text().split():
        for task in Path("/proc", process, "task").iterdir():
            words = (task / "stat").read_text().rpartition(")")[2].split()
            policy, priority = int(words[38]), int(words[37])  # proc(5)
            threads[(task / "comm").read_text().strip()] = (policy, priority)
    named = {name: threads.pop(name) for name in ("controller", "lower", "upper")}
    assert named == {"controller": (FIFO, 20), "lower": (FIFO, 10), "upper": (FIFO, 10)}
    assert "pair" in threads and set(threads.values()) == {(OTHER, 0)}
    status = Path("/proc", show("MainPID"), "status").read_text().splitlines()
    assert next(int(line.split()[1]) for line in status if line.startswith("VmLck")) > 100_000


def test_commands_turn_the_wheels_and_their_absence_stops_them(operator: GuestOperator, wheels: Wheels) -> None:
    until(lambda: wheels.state()["commands"] > 3)
    before = wheels.state()
    assert before["fastest_mps"] == 0.0

    def stops_for_want_of_commands() -> bool:
        operator.driving = True
        until(lambda: wheels.commanded_mps > 0.25)
        operator.driving = False
        until(lambda: wheels.commanded_mps == 0.0)
        return "the wheels stop: the command is stale" in journal()

    until(stops_for_want_of_commands)  # a slow machine may have no pose for as long
    after = wheels.state()
    assert after["errors"] == before["errors"] and after["way_m"] > 0.05


def test_a_lost_camera_stops_the_wheels_until_it_is_back(
    sample_log: SampleLog, operator: GuestOperator, wheels: Wheels
) -> None:
    operator.driving = True
    until(lambda: wheels.commanded_mps > 0.25)
    sample_log.close("lower")
    try:
        until(lambda: wheels.commanded_mps == 0.0)
        until(lambda: operator.message("lower camera").startswith("camera /dev/omnid/lower"))
        until(lambda: operator.message("pairing") == "no images of the lower camera")
        until(lambda: wheels.state()["fastest_mps"] == 0.0)  # a slow machine may have had a pose in work
    finally:
        sample_log.open("lower")
    operator.more(3)
    until(lambda: wheels.commanded_mps > 0.25)
    lost = [text for text in journal() if "lower camera: " in text]
    assert sum("lost, and tried again" in text for text in lost) == 1 and sum(": back, " in text for text in lost) == 1
    assert show("NRestarts") == "0"


def test_a_killed_daemon_stops_the_wheels_until_it_is_back(operator: GuestOperator, wheels: Wheels) -> None:
    pid, before = int(show("MainPID")), wheels.state()
    os.kill(pid, signal.SIGKILL)
    until(lambda: wheels.commanded_mps == 0.0)
    after = wheels.state()
    assert after["expiries"] == before["expiries"], "the base controller stopped them, long before the watchdog"
    until(lambda: int(show("MainPID")) not in (0, pid))
    assert wheels.state()["fastest_mps"] == 0.0
    wait_for_restart(pid)
    operator.more(3)
    until(lambda: wheels.commanded_mps > 0.25)
    assert wheels.state()["unsafe_resumes"] == 0


def test_a_daemon_that_stalls_is_started_again(operator: GuestOperator, wheels: Wheels) -> None:
    pid = int(show("MainPID"))
    os.kill(pid, signal.SIGSTOP)
    until(lambda: wheels.commanded_mps == 0.0)
    wait_for_restart(pid)
    lines = journal()
    assert any("Watchdog timeout" in text for text in lines)
    assert any("Fatal Python error: Aborted" in text for text in lines)
    operator.more(3)
    until(lambda: wheels.commanded_mps > 0.25)


def test_stopping_the_unit_stops_the_wheels(operator: GuestOperator, wheels: Wheels) -> None:
    before = wheels.state()
    run("systemctl", "stop", "--no-block", "omnid")
    until(lambda: wheels.commanded_mps == 0.0)
    assert wheels.state()["expiries"] == before["expiries"], "stopped by a command, long before the watchdog"
    run("systemctl", "stop", "omnid")
    after = wheels.state()
    assert after["commanded_mps"] == after["fastest_mps"] == 0.0
    assert (show("ActiveState"), show("Result"), show("ExecMainStatus")) == ("inactive", "success", "0")
    assert after["unsafe_resumes"] == 0 and not any("Traceback" in text for text in journal())
