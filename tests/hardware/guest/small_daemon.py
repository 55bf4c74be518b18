"""A daemon with the real graph, bus and service, in which a stage stalls on request.

It writes its rights and its threads to /var/lib/omnid/report.json.
"""

from __future__ import annotations

import json
import logging
import os
import signal
import socket
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from omnid.diagnostics.run_statistics import RunStatistics
from omnid.engine.graph import NEWEST, Graph
from omnid.engine.logging_setup import configure_logging, log
from omnid.engine.realtime import RealtimeSettings, ThreadStart, prepare, priorities
from omnid.runs.systemd import Service, StatusLine, print_stacks_when_killed
from omnid.transport.bus import Bus, BusConfig

HANG = Path("/run/omnid/hang")
REPORT = Path("/var/lib/omnid/report.json")
TASKS = Path("/proc/self/task")
FOLDERS = "/etc/omnid", "/opt/omnid", "/var/lib", "/var/lib/omnid", "/run/omnid"
DEVICES = "/dev/ttyS1", "/dev/video0", "/dev/vda", "/dev/kmsg"
HOSTS = "127.0.0.1", "192.168.1.5"
PORT = 7000


def numbers() -> Iterator[int]:
    """A camera of 20 Hz."""
    while True:
        time.sleep(0.05)
        yield 0


class Image:
    """A stage that uses OpenCV, until it hangs."""

    def process(self, number: int) -> int:
        """Blur an image, and stall if requested."""
        cv2.blur(np.zeros((50, 50), np.uint8), (3, 3))
        if HANG.exists():
            self.where_it_hangs()
        return number

    def where_it_hangs(self) -> None:
        """Sleep for 1000 s."""
        HANG.unlink()
        time.sleep(1000)


class Speaker:
    """A sink on the bus."""

    def __init__(self, bus: Bus) -> None:
        self._bus = bus

    def process(self, number: int) -> None:
        """Publishes."""
        self._bus.publish("odom", b"pose")


def outcome(action: Callable[[], object]) -> str:
    """Return "done" or the error of an action."""
    try:
        action()
    except OSError as error:
        return error.strerror or type(error).__name__
    return "done"


def opened(path: str) -> str:
    """Return the result of opening a device."""
    return outcome(lambda: os.close(os.open(path, os.O_RDWR | os.O_NOCTTY | os.O_NONBLOCK)))


def reached(host: str) -> str:
    """Return the result of connecting to a host."""
    return outcome(lambda: socket.create_connection((host, PORT), 3).close())


def threads() -> dict[str, tuple[int, int]]:
    """Return policy and priority of the threads by name (proc(5))."""
    found = {}
    for task in TASKS.iterdir():
        words = (task / "stat").read_text().rpartition(")")[2].split()
        found[(task / "comm").read_text().strip()] = (int(words[38]), int(words[37]))
    return found


def report() -> dict[str, Any]:
    """Return all facts that the tests check."""
    status = dict(line.split(":", 1) for line in Path("/proc/self/status").read_text().splitlines())
    return {
        "pid": os.getpid(),
        "threads": threads(),
        "locked_kb": int(status["VmLck"].split()[0]),
        "written": {path: outcome(Path(path, "x").touch) for path in FOLDERS},
        "opened": {path: opened(path) for path in DEVICES},
        "reached": {host: reached(host) for host in HOSTS},
    }


class Reporter:
    """Writes the report, once."""

    def __init__(self) -> None:
        self._left = 20

    def __call__(self) -> None:
        """Write the report at the 20th call, when all threads are running."""
        self._left -= 1
        if self._left == 0:
            text = json.dumps(report())
            REPORT.with_suffix(".new").write_text(text)
            REPORT.with_suffix(".new").rename(REPORT)


def main() -> None:
    """Runs until SIGTERM."""
    print_stacks_when_killed()
    configure_logging()
    config, statistics, bus = RealtimeSettings(), RunStatistics(), Bus(BusConfig())
    graph = Graph(policy=NEWEST, on_thread=ThreadStart({"motor": config.motor_priority, **priorities(config, "lower")}))
    graph.sink("bus", Speaker(bus), graph.stage("image", Image(), graph.source("lower", numbers)))
    graph.ticker("motor", 0.05, lambda: None)
    graph.ticker("report", 0.1, Reporter())
    service = Service(graph.telemetry, StatusLine(statistics, graph.telemetry, ("motor", "report", "watchdog")), 5.0)
    graph.ticker("watchdog", service.period_s, service)
    signal.signal(signal.SIGTERM, lambda *_: graph.stop())
    for line in prepare(config):
        log(logging.WARNING, line)
    graph.run()
    bus.close()


if __name__ == "__main__":
    main()
