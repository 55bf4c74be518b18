"""Cost and latency of the bus: `python -m pytest -m benchmark -s tests/benchmark/test_bus.py`.

Every subscriber and the router run in processes of their own.
"""

from __future__ import annotations

import contextlib
import json
import os
import re
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any, cast

import numpy as np
import pytest

from calib import se3
from omnid.client import Diagnostics, Robot, Subscription
from omnid.engine.telemetry import Histogram
from omnid.messages import OdometryUpdate
from omnid.sinks.bus_sink import BusSink
from omnid.sinks.encoder import Encoder, MapEncoding
from omnid.transport.bus import Bus, BusConfig
from omnid.transport.decode import decode_pose
from tests.benchmark.results import Column, ResultTable
from tests.omnid.transport.bus_fixtures import ROUTER, free_endpoint, script
from tests.waiting import wait_until

pytestmark = pytest.mark.benchmark
RATE_HZ = 30.0

# Counts the poses of each robot that arrive and that are missing, and measures their latency.
COUNTER = """
import json, sys, time, zenoh
config = zenoh.Config()
config.insert_json5("mode", '"client"')
config.insert_json5("connect/endpoints", json.dumps([sys.argv[1]]))
config.insert_json5("scouting/multicast/enabled", "false")
last, latencies_s, missed = {}, [], [0]
def take(sample):
    now_ns = time.time_ns()
    note = json.loads(sample.attachment.to_bytes())
    key, seq = str(sample.key_expr), note["seq"]
    missed[0] += seq - last.get(key, seq - 1) - 1
    last[key] = seq
    latencies_s.append((now_ns - note["sent_ns"]) * 1e-9)
with zenoh.open(config) as session:
    poses = session.declare_subscriber("**/odom", take)
    rest = session.declare_subscriber("**/pose", lambda sample: None)
    print("ready", flush=True)
    for line in sys.stdin:
        latencies_s.sort()
        print(json.dumps({
            "received": len(latencies_s), "missed": missed[0], "newest": min(last.values()),
            "p50_ms": 1e3 * latencies_s[len(latencies_s) // 2],
            "p99_ms": 1e3 * latencies_s[int(0.99 * len(latencies_s))],
        }), flush=True)
        latencies_s.clear(); missed[0] = 0
"""


def new_counts(process: subprocess.Popen[str]) -> dict[str, float]:
    """Return the counts of a counter since the last call."""
    assert process.stdin is not None and process.stdout is not None
    process.stdin.write("\n")
    process.stdin.flush()
    return cast("dict[str, float]", json.loads(process.stdout.readline()))


@contextlib.contextmanager
def counter(endpoint: str) -> Iterator[subprocess.Popen[str]]:
    arguments = [sys.executable, "-c", COUNTER, endpoint]
    with subprocess.Popen(arguments, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True) as process:
        try:
            assert process.stdout is not None and process.stdout.readline() == "ready\n"
            yield process
        finally:
            process.kill()


def odometry(seq: int) -> OdometryUpdate:
    T = se3.transform(se3.rotation_exp([0.0, 0.0, 1e-3 * seq]), [1e-3 * seq, 0.0, 0.0])
    return OdometryUpdate(
        seq, time.time_ns(), T, np.eye(6), np.zeros(6), np.eye(6), "tracking", 0, 50, 60, cast("Any", None)
    )


def publish(sinks: list[BusSink], first: int, count: int) -> Histogram:
    """Publish poses on all sinks with RATE_HZ and return the cost of each pose with its accompanying messages.

    This process sleeps between the poses, so its caches are cold: the daemon's own cost is in its stage statistics.
    """
    cost = Histogram()
    next_s = time.monotonic()
    for seq in range(first, first + count):
        for sink in sinks:
            message, started_s = odometry(seq), time.perf_counter()
            sink.process(message)
            cost.add(time.perf_counter() - started_s)
        next_s += 1.0 / RATE_HZ
        time.sleep(max(0.0, next_s - time.monotonic()))
    return cost


def sink_on(bus: Bus) -> BusSink:
    return BusSink(bus, Encoder(np.eye(4), MapEncoding(1000)))


@pytest.mark.parametrize("way", ["direct", "router"])
def test_latency_and_cost(way: str) -> None:
    here, there = free_endpoint(), free_endpoint()
    with contextlib.ExitStack() as ends:
        if way == "router":
            ends.enter_context(script(ROUTER, there))
        connect = (there,) if way == "router" else ()
        bus = ends.enter_context(contextlib.closing(Bus(BusConfig(listen=(here,), connect=connect))))
        listener = ends.enter_context(counter(there if way == "router" else here))
        sink = sink_on(bus)
        publish([sink], 0, 30)
        new_counts(listener)
        cost = publish([sink], 30, 300)
        time.sleep(0.5)
        found = new_counts(listener)
    columns = (
        Column("way"),
        Column("one way p50", "ms", 2),
        Column("one way p99", "ms", 2),
        Column("poses of 300"),
        Column("publishing p50", "ms", 2),
        Column("publishing p99", "ms", 2),
    )
    table = ResultTable("bus_latency", "speed", "Poses on the bus", columns, continued=True)
    table.add(way, found["p50_ms"], found["p99_ms"], found["received"], 1e3 * cost.p(0.5), 1e3 * cost.p(0.99))
    assert found["newest"] == 329 and found["missed"] == 0


def test_poses_pass_a_restarted_router_within_five_seconds() -> None:
    here, there = free_endpoint(), free_endpoint()
    with contextlib.ExitStack() as ends:
        router = ends.enter_context(script(ROUTER, there))
        bus = ends.enter_context(contextlib.closing(Bus(BusConfig(listen=(here,), connect=(there,)))))
        direct, behind = ends.enter_context(counter(here)), ends.enter_context(counter(there))
        sink = sink_on(bus)
        publish([sink], 0, 30)
        new_counts(direct), new_counts(behind)
        router.kill()
        router.wait()
        publish([sink], 30, 90)
        ends.enter_context(script(ROUTER, there))
        back_s = time.monotonic()
        publish([sink], 120, 180)
        time.sleep(0.3)
        near, far = new_counts(direct), new_counts(behind)
    missed_s = far["missed"] / RATE_HZ - 3.0
    columns = (
        Column("fault"),
        Column("direct: missed"),
        Column("direct: received"),
        Column("behind the router: poses again after", "s", 1),
        Column("measured", "s", 0),
    )
    table = ResultTable("bus_router", "speed", "A router that is killed", columns)
    table.add("router killed for 3 s", near["missed"], near["received"], missed_s, time.monotonic() - back_s)
    assert near["missed"] == 0 and near["newest"] == far["newest"] == 299 and missed_s < 5.0


SLOW = """
import json, sys, time, zenoh
config = zenoh.Config()
config.insert_json5("mode", '"client"')
config.insert_json5("connect/endpoints", json.dumps([sys.argv[1]]))
config.insert_json5("scouting/multicast/enabled", "false")
with zenoh.open(config) as session:
    all = session.declare_subscriber("omnid/**", lambda sample: time.sleep(0.5))
    print("ready", flush=True)
    time.sleep(1000)
"""


def test_a_slow_subscriber_does_not_delay_others(scene: Path) -> None:
    """Run the daemon on a log, alone and with a subscriber that takes half a second for each message."""
    endpoint = free_endpoint()
    words = [
        sys.executable,
        "-m",
        "omnid",
        "run",
        "--log",
        scene / "log.mcap",
        "--rig",
        scene / "rig.toml",
        "--set",
        f"bus.listen=['{endpoint}']",
        "--set",
        "bus.panorama_hz=10",
        "--set",
        "live.cloud_s=0.5",
    ]
    with subprocess.Popen(words, stderr=subprocess.DEVNULL) as daemon:
        try:
            with Robot(connect=(endpoint,), timeout_s=30.0) as robot, robot.subscribe(Diagnostics) as reports:
                rates = {"alone": measured(robot)}
                with script(SLOW, endpoint):
                    rates["with a slow subscriber"] = measured(robot)
                last = full(reports)
        finally:
            daemon.terminate()
    work_ms, cost_ms = (
        [float(last.value("omnid: stage bus", f"{kind}_{which}_ms")) for which in ("p50", "p99")]
        for kind in ("work", "cpu")
    )
    columns = (
        Column("subscribers"),
        Column("poses/s", "", 1),
        Column("capture to network p50", "ms", 1),
        Column("capture to network p99", "ms", 1),
    )
    table = ResultTable("bus_slow_subscriber", "speed", "A slow subscriber on the bus", columns)
    for name, figures in rates.items():
        table.add(name, *figures)
    times = ResultTable(
        "bus_publishing",
        "speed",
        "Time to publish a pose",
        (Column("time"), Column("p50", "ms", 2), Column("p99", "ms", 2)),
    )
    times.add("processor", *cost_ms)
    times.add("with waiting for the interpreter", *work_ms)
    alone, slow = rates.values()
    assert slow[0] > 0.8 * alone[0] and cost_ms[0] < 1.0


def measured(robot: Robot) -> tuple[float, float, float]:
    """Return poses/s of the daemon over ten seconds, and p50 and p99 of the time from capture to network [ms]."""
    ages_ms: list[float] = []

    def take(topic: str, payload: bytes, note: bytes) -> None:
        if topic == "odom":
            pose = decode_pose(payload, note)
            ages_ms.append((pose.attachment.sent_ns - pose.stamp_ns) * 1e-6)

    robot.on_message(take)
    wait_until(lambda: bool(ages_ms))
    time.sleep(3.0)
    ages_ms.clear()
    with robot.subscribe(Diagnostics) as reports:
        rates_hz = [float(full(reports).value("omnid: odometry", "rate_hz")) for _ in range(10)]
    return float(np.mean(rates_hz)), float(np.percentile(ages_ms, 50)), float(np.percentile(ages_ms, 99))


def full(reports: Subscription[Diagnostics]) -> Diagnostics:
    """Return the next complete report."""
    while (report := reports.wait(5.0)) is None or not report.value("omnid: odometry", "rate_hz"):
        pass
    return report


def cpu_s(pid: int) -> float:
    """Return the processor time of a process so far [s]."""
    fields = re.sub(r".*\)", "", Path(f"/proc/{pid}/stat").read_text()).split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")
