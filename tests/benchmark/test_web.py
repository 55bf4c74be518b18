"""Cost and latency of the page: `python -m pytest -m benchmark -s tests/benchmark/test_web.py`.

The daemon runs on the sample log, in real time. One browser is Chromium, the others are programs that answer each
message, as the page does: ten Chromiums would take all the processors, and the server would see no difference.
"""

from __future__ import annotations

import contextlib
import shutil
import subprocess
import sys
import time
from collections.abc import Iterator
from importlib.resources import files
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from omnid.client import Pose, Robot
from omnid.transport.bus import Bus, BusConfig
from tests.benchmark.results import Column, ResultTable
from tests.benchmark.test_bus import cpu_s, publish, sink_on
from tests.omnid.transport.bus_fixtures import free_endpoint, script
from tests.omnid.web.servers import ROOT, WebServer, served
from tests.waiting import wait_until

pytestmark = pytest.mark.benchmark
CHROMIUM = shutil.which("chromium") or shutil.which("google-chrome")
WARM_UP_S, MEASURED_S = 5.0, 20.0

VISITORS = """
import sys, threading, time
from websockets.sync.client import connect
def visit():
    with connect(sys.argv[1], additional_headers={"Authorization": "Bearer " + sys.argv[2]}, compression=None) as live:
        for _ in live:
            live.send("ok")
for _ in range(int(sys.argv[3])):
    threading.Thread(target=visit, daemon=True).start()
print("ready", flush=True)
time.sleep(1000)
"""

# Times from the robot's network to the page, once a pose, in ms: when its text is set, and after the next frame.
MEASURE = """() => {
  window.times = [];
  let newest = 0;
  const now = () => performance.timeOrigin + performance.now();
  document.addEventListener("omnid-state", (event) => {
    const sent = event.detail.pose?.sent_ms ?? 0;
    if (sent <= newest) return;
    newest = sent;
    const shown = now() - sent;
    requestAnimationFrame(() => setTimeout(() => window.times.push([shown, now() - sent]), 0));
  });
}"""


@contextlib.contextmanager
def sample_daemon(endpoint: str) -> Iterator[subprocess.Popen[bytes]]:
    log = str(files("omnid.sample") / "log.mcap")
    command = [
        sys.executable,
        "-m",
        "omnid",
        "run",
        "--log",
        log,
        "--motor",
        "simulated",
        "--set",
        f'bus.listen=["{endpoint}"]',
    ]
    with subprocess.Popen(command, cwd=ROOT, stderr=subprocess.DEVNULL) as daemon:
        try:
            yield daemon
        finally:
            daemon.terminate()


def measured(name: str, daemon: subprocess.Popen[bytes], server: WebServer, robot: Robot) -> None:
    """Record the processor time of the daemon for a pose, and of the page's server."""
    time.sleep(WARM_UP_S)
    ages_ms: list[float] = []
    with robot.subscribe(Pose) as poses:
        pids, begin_s = (daemon.pid, server.process.pid), time.monotonic()
        before = [cpu_s(pid) for pid in pids]
        first = newest = next(iter(poses))
        while time.monotonic() < begin_s + MEASURED_S:
            newest = poses.wait(1.0) or newest
            ages_ms.append(1e-6 * (newest.attachment.sent_ns - newest.stamp_ns))
        used_s, span_s = [cpu_s(pid) - at for pid, at in zip(pids, before, strict=True)], time.monotonic() - begin_s
    count = newest.attachment.seq - first.attachment.seq
    columns = (
        Column("browsers"),
        Column("poses/s", "", 1),
        Column("daemon, processor time a pose", "ms", 1),
        Column("capture to network p50", "ms", 0),
        Column("page's server, of one core", "%", 1),
    )
    table = ResultTable("web_processor", "speed", "Processor time of the page", columns, continued=True)
    table.add(name, count / span_s, 1e3 * used_s[0] / count, np.percentile(ages_ms, 50), 100 * used_s[1] / span_s)


@pytest.mark.skipif(CHROMIUM is None, reason="needs chromium")
def test_latency_and_processor_time() -> None:
    playwright: Any = pytest.importorskip("playwright.sync_api", reason="needs playwright")
    endpoint = free_endpoint()
    with contextlib.ExitStack() as ends:
        daemon = ends.enter_context(sample_daemon(endpoint))
        robot = ends.enter_context(Robot(connect=(endpoint,), timeout_s=60.0))
        server = ends.enter_context(served("--connect", endpoint))
        with robot.subscribe(Pose) as poses:
            wait_until(lambda: poses.newest() is not None)
        visitors = (VISITORS, f"ws://{server.host}/live", server.token)
        measured("no browser", daemon, server, robot)
        with script(*visitors, "1"):
            measured("1 browser (program)", daemon, server, robot)
        with script(*visitors, "10"):
            measured("10 browsers (programs)", daemon, server, robot)
        tools = ends.enter_context(playwright.sync_playwright())
        browser = tools.chromium.launch(executable_path=CHROMIUM, args=["--no-sandbox"])
        ends.callback(browser.close)
        for others in (0, 9):
            page = browser.new_page(viewport={"width": 1440, "height": 900})
            page.goto(server.url)
            with script(*visitors, str(others)):
                page.wait_for_timeout(1e3 * WARM_UP_S)
                page.evaluate(MEASURE)
                page.wait_for_timeout(1e3 * MEASURED_S)
                times_ms = np.array(page.evaluate("() => window.times"))
            page.close()
            shown, drawn = (np.percentile(times_ms[:, which], (50, 99)) for which in (0, 1))
            columns = (
                Column("browsers"),
                Column("poses"),
                Column("network to text p50", "ms", 1),
                Column("network to text p99", "ms", 1),
                Column("network to drawn frame p50", "ms", 1),
                Column("network to drawn frame p99", "ms", 1),
            )
            table = ResultTable("web_latency", "speed", "Latency of the page", columns, continued=True)
            table.add(f"Chromium and {others} others", len(times_ms), *shown, *drawn)
            assert len(times_ms) > 30


def test_processor_time_at_30_hz() -> None:
    """Publish poses alone, three times as fast as the sample log has them."""
    endpoint = free_endpoint()
    with contextlib.closing(Bus(BusConfig(listen=(endpoint,)))) as bus, served("--connect", endpoint) as server:
        sinks, seq = [sink_on(bus)], 0
        table = ResultTable(
            "web_poses",
            "speed",
            "The page's server at 30 poses/s, poses alone",
            (Column("browsers"), Column("of one core", "%", 1)),
        )
        for browsers in (0, 1, 10):
            with script(VISITORS, f"ws://{server.host}/live", server.token, str(browsers)):
                publish(sinks, seq, 60)
                before_s, begin_s = cpu_s(server.process.pid), time.monotonic()
                publish(sinks, seq + 60, 300)
                share = (cpu_s(server.process.pid) - before_s) / (time.monotonic() - begin_s)
                seq += 360
            table.add(browsers, 100 * share)
        metrics = server.request("/metrics", headers=server.bearer).text
    assert f"omnid_poses_total {seq}\n" in metrics and "omnid_poses_missed_total 0\n" in metrics


def test_poses_are_the_same_with_ten_browsers(scene: Path, tmp_path: Path) -> None:
    endpoint = free_endpoint()

    def path(name: str) -> bytes:
        tum = tmp_path / name
        subprocess.run(
            [
                sys.executable,
                "-m",
                "omnid",
                "replay",
                scene / "log.mcap",
                "--rig",
                scene / "rig.toml",
                "--quiet",
                "--publish",
                "--tum",
                tum,
                "--set",
                f'bus.listen=["{endpoint}"]',
            ],
            cwd=ROOT,
            check=True,
            stdout=subprocess.DEVNULL,
        )
        return tum.read_bytes()

    alone = path("alone.txt")
    with served("--connect", endpoint) as server, script(VISITORS, f"ws://{server.host}/live", server.token, "10"):
        watched = path("watched.txt")
        metrics = server.request("/metrics", headers=server.bearer).text
    received = next(int(line.split()[1]) for line in metrics.splitlines() if line.startswith("omnid_poses_total"))
    print(f"\n{alone.count(10)} poses, of which the page received {received}; same bytes: {alone == watched}")
    assert alone == watched and received > 0
