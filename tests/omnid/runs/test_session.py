"""Parts of runs: warnings at the start, the rig of a log, the first images, the line on a terminal, and systemd's view.

Notifications, watchdog, and the difference between a stalled and an idle stage.
"""

from __future__ import annotations

import logging
import os
import re
import select
import signal
import socket
import subprocess
import sys
import threading
import time
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace

import pytest

from omnid.diagnostics.run_summary import RunStatistics
from omnid.engine.graph import NEWEST, Graph
from omnid.engine.telemetry import Telemetry
from omnid.runs.systemd import Service, StatusLine, notify, watchdog_s
from omnid.transport.status_names import Key
from tests.waiting import wait_until


def test_the_line_and_the_summary_of_a_run() -> None:
    statistics = RunStatistics()
    line = StatusLine(statistics, Telemetry(), lambda: {Key.REAL_TIME_FACTOR: 0.5})
    assert line() == "waiting for images, 0.0 poses/s, 0 messages dropped, 0 deadlines missed, 0.50 x real time"
    assert line.summary() == "ended: 0 poses, 0.00 m, 0 resets"
    statistics.poses, statistics.length_m, statistics.resets = 4, 12.345, 1
    statistics.states = Counter({"tracking": 3, "lost": 1})
    assert line.summary() == "ended: 4 poses, 12.35 m, 1 resets; tracking 75.0%, lost 25.0%"


ROOT = Path(__file__).parents[3]
TIMEOUT_S = 20.0  # reached by a broken service only


class Manager:
    """systemd's side of the socket."""

    def __init__(self, address: str) -> None:
        self._socket = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
        self._socket.bind(address.replace("@", "\0"))
        self._socket.settimeout(TIMEOUT_S)

    def received(self) -> list[str]:
        """Return the lines of the next message."""
        return self._socket.recv(4096).decode().split("\n")

    def is_empty(self) -> bool:
        """True if no message waits."""
        return not select.select([self._socket], [], [], 0)[0]

    def close(self) -> None:
        """Close the socket."""
        self._socket.close()


@pytest.fixture
def manager(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Manager]:
    monkeypatch.setenv("NOTIFY_SOCKET", str(tmp_path / "notify"))
    manager = Manager(str(tmp_path / "notify"))
    yield manager
    manager.close()


@pytest.mark.parametrize("address", ["", "relative", "/nowhere/notify", "@nosuch", "/" + "x" * 200, "vsock:2:1"])
def test_a_missing_manager_is_no_error(address: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("NOTIFY_SOCKET", address)
    assert not notify("READY=1")


@pytest.mark.parametrize(
    ("usec", "pid", "expected"),
    [
        ("10000000", "", 10.0),
        ("3000000", "own", 3.0),
        ("3000000", "1", None),
        ("", "", None),
        ("0", "", None),
        ("x", "", None),
    ],
)
def test_reads_the_timeout_of_the_watchdog(
    usec: str, pid: str, expected: float | None, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("WATCHDOG_USEC", usec)
    monkeypatch.setenv("WATCHDOG_PID", str(os.getpid()) if pid == "own" else pid)
    assert watchdog_s() == expected
    assert Service(Telemetry(), str, 1.0).period_s == pytest.approx(min(1.0, (expected or 3.0) / 3))


def test_sends_ready_once_then_watchdog_then_stopping(manager: Manager) -> None:
    service = Service(Telemetry(), lambda: "3 poses\nREADY=1", 1.0)
    service()
    service()
    service.close()
    assert manager.received() == ["READY=1", "WATCHDOG=1", "STATUS=3 poses READY=1"]
    assert manager.received() == ["WATCHDOG=1", "STATUS=3 poses READY=1"]
    assert manager.received() == ["STOPPING=1", "STATUS=stopping"]


class Valve:
    """A stage that works on a message until it is opened."""

    def __init__(self) -> None:
        self.entered, self.open = threading.Event(), threading.Event()

    def process(self, number: int) -> int:
        self.entered.set()
        assert self.open.wait(TIMEOUT_S)
        return number


class Tap:
    """A source of as many numbers as it is set to: a camera that delivers images, or none."""

    def __init__(self) -> None:
        self.left, self.closed = 0, False

    def numbers(self) -> Iterator[int]:
        while not self.closed:
            if self.left:
                self.left -= 1
                yield self.left
            else:
                time.sleep(0.001)

    def close(self) -> None:
        self.closed = True


@pytest.fixture
def running() -> Iterator[SimpleNamespace]:
    """A running graph: tap, valve, sink."""
    graph, tap, valve = Graph(policy=NEWEST), Tap(), Valve()
    sink = SimpleNamespace(process=lambda number: None)
    graph.sink("sink", sink, graph.stage("valve", valve, graph.source("tap", tap.numbers, wake=tap.close)))
    thread = threading.Thread(target=graph.run)
    thread.start()
    yield SimpleNamespace(graph=graph, tap=tap, valve=valve)
    valve.open.set()
    graph.stop()
    thread.join(TIMEOUT_S)
    assert not thread.is_alive()


def test_a_stalled_stage_stops_the_watchdog_and_is_logged_once(
    manager: Manager, running: SimpleNamespace, caplog: pytest.LogCaptureFixture
) -> None:
    caplog.set_level(logging.INFO, "omnid")
    service = Service(running.graph.telemetry, lambda: "tracking", 0.5)
    running.tap.left = 1
    assert running.valve.entered.wait(TIMEOUT_S)
    service()
    assert "WATCHDOG=1" in manager.received()  # it has only just begun
    time.sleep(0.6)
    service()
    service()
    (status,) = manager.received()
    assert re.match(r"STATUS=valve stalled for \d+ s, tracking", status)
    assert caplog.text.count("stage 'valve' is stalled") == 1
    running.valve.open.set()
    wait_until(lambda: not any(stats.busy_since_ns for stats in running.graph.telemetry.stages))
    assert manager.received() == [status]
    service()
    assert "WATCHDOG=1" in manager.received()


def test_a_run_notifies_systemd_from_its_first_tick_to_its_end(manager: Manager) -> None:
    graph, tap = Graph(policy=NEWEST), Tap()
    graph.sink("sink", SimpleNamespace(process=lambda number: None), graph.source("tap", tap.numbers, wake=tap.close))
    graph.ticker("service", 0.01, Service(graph.telemetry, str, 1.0))
    thread = threading.Thread(target=graph.run)
    thread.start()
    assert manager.received()[:2] == ["READY=1", "WATCHDOG=1"]
    graph.stop()
    thread.join(TIMEOUT_S)
    messages = [manager.received()]
    while messages[-1][0] != "STOPPING=1":
        messages.append(manager.received())
    assert manager.is_empty()


def test_prints_the_stacks_when_killed() -> None:
    stuck = (
        "import os, signal, time; from omnid.runs.systemd import print_stacks_when_killed\n"
        "def stalled_function():\n  os.kill(os.getpid(), signal.SIGABRT); time.sleep(20)\n"
        "print_stacks_when_killed()\nstalled_function()"
    )
    done = subprocess.run([sys.executable, "-c", stuck], cwd=ROOT, capture_output=True, text=True)
    assert done.returncode == -signal.SIGABRT
    assert "in stalled_function" in done.stderr
