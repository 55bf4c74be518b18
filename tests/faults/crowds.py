"""Crowds of connections: `omnid stop` and STOP on the page get through beside them.

A crowd is another process: zenoh sessions that do nothing, as many of a thousand as are accepted; connections that send
nothing, to the bus and to the page; connections to a page with TLS that begin no handshake. Connections that are closed
are made again without a pause. The time of `omnid stop` is that of its work, without the start of Python.
"""

from __future__ import annotations

import json
import ssl
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from http.client import HTTPConnection, HTTPSConnection
from pathlib import Path
from typing import Final
from urllib.parse import parse_qs, urlsplit

from omnid.monitor.stopping import stop
from omnid.transport.bus_config import BusConfig
from tests.benchmark.results import Column, ResultTable
from tests.replay.live import ROOT, robot

SESSIONS: Final = 1000
SILENT: Final = 2000
LONGEST_STOP_S: Final = 1.0
STOPS: Final = 5
SESSION_CROWD: Final = """
import json, sys, time, zenoh
held, end_s = [], time.monotonic() + 60.0
for _ in range(int(sys.argv[2])):
    config = zenoh.Config()
    for name, value in (("mode", "client"), ("connect/endpoints", [sys.argv[1]]), ("scouting/multicast/enabled", False),
                        ("connect/timeout_ms", 1000)):
        config.insert_json5(name, json.dumps(value))
    try:
        held.append(zenoh.open(config))
    except zenoh.ZError:
        if time.monotonic() > end_s:
            break
print(len(held), flush=True)
time.sleep(3600)
"""
SILENT_CROWD: Final = """
import resource, select, socket, sys, time
resource.setrlimit(resource.RLIMIT_NOFILE, (min(8192, resource.getrlimit(resource.RLIMIT_NOFILE)[1]),) * 2)
port, count = int(sys.argv[1]), int(sys.argv[2])
poll, held = select.epoll(), {}
def add():
    one = socket.socket()
    one.setblocking(False)
    one.connect_ex(("127.0.0.1", port))
    held[one.fileno()] = one
    poll.register(one, select.EPOLLRDHUP | select.EPOLLHUP | select.EPOLLERR)
for _ in range(count):
    add()
time.sleep(1.0)
print(len(held), flush=True)
while True:
    for number, _ in poll.poll(1.0):
        held.pop(number).close()
        add()
"""


@contextmanager
def crowd(text: str, *words: object) -> Iterator[int]:
    """Run a crowd until the end of the block; yield its number when it is there."""
    with subprocess.Popen(
        [sys.executable, "-P", "-c", text, *map(str, words)], stdout=subprocess.PIPE, text=True, cwd=ROOT
    ) as process:
        try:
            assert process.stdout is not None
            yield int(process.stdout.readline())
        finally:
            process.kill()


def timed_stop(port: int) -> float:
    """Return how long a stop takes until the robot confirms it, s; 99 where it does not."""
    begin_s = time.monotonic()
    done = stop(BusConfig(connect=(f"tcp/127.0.0.1:{port}",)), answer_s=15.0)
    return time.monotonic() - begin_s if done else 99.0


class Page:
    """`omnid web` for the robot, with TLS or without."""

    def __init__(self, ends: ExitStack, robot_port: int, tls: tuple[Path, Path] | None) -> None:
        words = [] if tls is None else ["--tls-certificate", str(tls[0]), "--tls-key", str(tls[1])]
        command = [
            sys.executable,
            "-P",
            "-m",
            "omnid",
            "web",
            "--listen",
            "127.0.0.1:0",
            "--connect",
            f"tcp/127.0.0.1:{robot_port}",
            *words,
        ]
        process = ends.enter_context(subprocess.Popen(command, stdout=subprocess.PIPE, text=True, cwd=ROOT))
        ends.callback(process.kill)
        assert process.stdout is not None
        url = urlsplit(process.stdout.readline().split()[0])
        self.port, self._token, self._tls = int(url.port or 0), parse_qs(url.query)["token"][0], tls is not None

    def timed_stop(self) -> float:
        """Return how long POST /stop takes until it is answered with "done", s; 99 for any other answer."""
        begin_s = time.monotonic()
        connection = (
            HTTPSConnection("127.0.0.1", self.port, timeout=30, context=ssl._create_unverified_context())
            if self._tls
            else HTTPConnection("127.0.0.1", self.port, timeout=30)
        )
        try:
            connection.request("POST", "/stop", headers={"Authorization": f"Bearer {self._token}"})
            answer = connection.getresponse()
            done = answer.status == 200 and json.loads(answer.read())["done"]
        except OSError:
            done = False
        finally:
            connection.close()
        return time.monotonic() - begin_s if done else 99.0


def certificate(folder: Path) -> tuple[Path, Path]:
    """Return a certificate and its key for 127.0.0.1, made by openssl."""
    pem, key = folder / "cert.pem", folder / "key.pem"
    subprocess.run(
        [
            "openssl",
            "req",
            "-x509",
            "-newkey",
            "rsa:2048",
            "-nodes",
            "-subj",
            "/CN=127.0.0.1",
            "-days",
            "2",
            "-keyout",
            str(key),
            "-out",
            str(pem),
        ],
        check=True,
        capture_output=True,
    )
    return pem, key


def run(recorded: Path, folder: Path) -> int:
    """Measure a row for each crowd; return the number of crowds that kept a stop out for more than LONGEST_STOP_S."""
    failed, own = 0, folder / "crowds"
    own.mkdir()
    table = ResultTable(
        "faults_crowds",
        "faults",
        "Stops beside crowds of connections",
        (Column("crowd"), Column("connections"), Column("stop by"), Column("longest of 5", "s", 2)),
        remarks=("Connections that are closed are made again at once.",),
    )

    def row(name: str, text: str, words: tuple[object, ...], way: str, timed: Callable[[], float]) -> None:
        nonlocal failed
        with crowd(text, *words) as there:
            longest_s = max(timed() for _ in range(STOPS))
        failed += longest_s > LONGEST_STOP_S
        table.add(name, there, way, longest_s)

    with robot(recorded, own) as (daemon, _, _), ExitStack() as ends:
        plain, secure = Page(ends, daemon.port, None), Page(ends, daemon.port, certificate(own))
        for page in (plain, secure):  # each has connected to the robot
            assert page.timed_stop() < 30
        bus = f"tcp/127.0.0.1:{daemon.port}"
        row(
            "zenoh sessions without any right",
            SESSION_CROWD,
            (bus, SESSIONS),
            "`omnid stop`",
            lambda: timed_stop(daemon.port),
        )
        row(
            "silent connections to the bus",
            SILENT_CROWD,
            (daemon.port, SILENT),
            "`omnid stop`",
            lambda: timed_stop(daemon.port),
        )
        row("silent connections to the page", SILENT_CROWD, (plain.port, SILENT), "POST /stop", plain.timed_stop)
        row(
            "TLS connections without a handshake",
            SILENT_CROWD,
            (secure.port, SILENT),
            "POST /stop, TLS",
            secure.timed_stop,
        )
    return failed
