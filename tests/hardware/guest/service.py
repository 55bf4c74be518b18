"""Run by pytest in the guest, as root: the unit under systemd, with a small daemon that replaces omnid.

The tests build on each other: the service starts, is inspected, gets a network, stalls, is killed, is stopped.
"""

from __future__ import annotations

import json
import os
import shutil
import signal
import socket
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from tests.hardware.guest.unit import DROP_INS, SYSTEMD, journal, restarted, run, show, until

REPORT = Path("/var/lib/omnid/report.json")
OPEN = "/etc/omnid", "/opt/omnid", "/dev/vda", "/dev/kmsg"  # to everybody: it is the unit that closes them
FIFO, OTHER = os.SCHED_FIFO, os.SCHED_OTHER
DAEMON = """[Service]
ExecStart=
ExecStart=/usr/bin/python3 -m tests.hardware.guest.small_daemon
Environment=PYTHONPATH=/opt/omnid
WatchdogSec=15
TimeoutStartSec=400
"""


def reported() -> dict[str, Any]:
    """Return the report of the running daemon."""

    def is_there() -> bool:
        return REPORT.exists() and json.loads(REPORT.read_text())["pid"] == int(show("MainPID"))

    until(is_there)
    return dict(json.loads(REPORT.read_text()))


@pytest.fixture(scope="module", autouse=True)
def unit() -> Iterator[None]:
    """The unit as the README installs it; the machine has a second address, at which it listens too."""
    run("modprobe", "vivid", "n_devs=1", "node_types=0x1")
    run("busybox", "ip", "link", "set", "lo", "up")
    run("busybox", "ip", "addr", "add", "192.168.1.5/24", "dev", "lo")
    run("useradd", "--system", "--no-create-home", "--shell", "/usr/sbin/nologin", "omnid")
    run("chmod", "-R", "a+rX", "/opt/omnid")
    Path("/etc/omnid").mkdir()
    run("chmod", "a+rwX", *OPEN)
    shutil.copy(SYSTEMD / "omnid.service", DROP_INS.parent)
    DROP_INS.mkdir()
    (DROP_INS / "daemon.conf").write_text(DAEMON)
    run("systemctl", "daemon-reload")
    with socket.create_server(("0.0.0.0", 7000), backlog=100):
        yield


def test_start_waits_until_it_is_ready() -> None:
    run("systemctl", "start", "omnid")  # waits for READY=1
    assert show("ActiveState") == "active" and show("StatusText").startswith("waiting for images")


def test_threads_have_names_and_only_two_have_priority() -> None:
    threads = {name: tuple(found) for name, found in reported()["threads"].items()}
    assert threads["motor"] == (FIFO, 20) and threads["lower"] == (FIFO, 10)
    assert {"image", "bus", "watchdog"} <= threads.keys()
    assert {found for name, found in threads.items() if name not in ("motor", "lower")} == {(OTHER, 0)}


def test_memory_is_locked() -> None:
    assert reported()["locked_kb"] > 100_000


def test_writes_only_to_its_own_folders() -> None:
    assert {path: found == "done" for path, found in reported()["written"].items()} == {
        "/etc/omnid": False,
        "/opt/omnid": False,
        "/var/lib": False,
        "/var/lib/omnid": True,
        "/run/omnid": True,
    }


def test_opens_only_cameras_and_serial_ports() -> None:
    assert {path: found == "done" for path, found in reported()["opened"].items()} == {
        "/dev/ttyS1": True,
        "/dev/video0": True,
        "/dev/vda": False,
        "/dev/kmsg": False,
    }


def test_reaches_only_this_machine_unless_more_is_allowed() -> None:
    found = reported()
    assert found["reached"]["127.0.0.1"] == "done" and found["reached"]["192.168.1.5"] != "done"
    shutil.copy(SYSTEMD / "lan.conf", DROP_INS)
    run("systemctl", "daemon-reload")
    run("systemctl", "restart", "omnid")
    assert reported()["reached"] == {"127.0.0.1": "done", "192.168.1.5": "done"}


def test_a_stalled_stage_is_logged_and_the_daemon_restarted() -> None:
    pid = reported()["pid"]
    Path("/run/omnid/hang").touch()
    restarted(pid)
    lines = journal()
    assert any(priority == 3 and text.startswith("stage 'image' is stalled") for priority, text in lines)
    assert any("in where_it_hangs" in text for _, text in lines)
    assert any(text == "omnid.service: Failed with result 'watchdog'." for _, text in lines)


def test_restarts_a_killed_daemon() -> None:
    pid = reported()["pid"]
    os.kill(pid, signal.SIGKILL)
    restarted(pid)
    assert int(show("NRestarts")) == 2


def test_stops_on_request() -> None:
    reported()
    run("systemctl", "stop", "omnid")
    assert (show("ActiveState"), show("Result")) == ("inactive", "success")
