"""Floods of messages on one key of the bus: the poses keep their rate, and a stop gets through.

The robot replays a recorded scene round after round. The flood comes from processes that only send. It takes its own
share of this machine's processors, so the rate of poses is compared with that under the same flood of a bus that
belongs to another process, a sink: what is left is what the flood costs the daemon.
"""

from __future__ import annotations

import json
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Final

import zenoh

from omnid.transport.codec import twist_stamped_cdr
from tests.benchmark.results import Column, ResultTable
from tests.faults.crowds import timed_stop
from tests.ports import free_port
from tests.replay.live import ROOT, Operator, robot

KEYS: Final = ("cmd/imu", "cmd/route", "cmd/arm", "cmd/twist", "cmd/stop", "cmd/nothing", "@request/arm")
SENDERS: Final = 2
MEASURED_S: Final = 8.0
LEAST_SHARE: Final = 0.9
LONGEST_STOP_S: Final = 1.0
COLUMNS: Final = (
    Column("flood on"),
    Column("poses before", "1/s", 1),
    Column("flood at another process", "1/s", 1),
    Column("flood here", "1/s", 1),
    Column("share", "%", 0),
    Column("stop", "s", 2),
)
FLOODER: Final = """
import json, sys, time, zenoh
endpoint, key, rate_hz, payload = sys.argv[1], sys.argv[2], float(sys.argv[3]), bytes.fromhex(sys.argv[4])
config = zenoh.Config()
for name, value in (("mode", "client"), ("connect/endpoints", [endpoint]), ("scouting/multicast/enabled", False)):
    config.insert_json5(name, json.dumps(value))
with zenoh.open(config) as session:
    publisher = session.declare_publisher(key, congestion_control=zenoh.CongestionControl.DROP)
    send = publisher.put
    if "@" in key:
        send = lambda payload: session.get(key, lambda reply: None, payload=payload, timeout=1.0)
    print("ready", flush=True)
    begin_s, sent = time.monotonic(), 0
    while True:
        due = (time.monotonic() - begin_s) * rate_hz
        while sent < due:
            send(payload)
            sent += 1
        if sent % 20000 < 200:
            print(sent, flush=True)
        time.sleep(0.001)
"""
SINK: Final = """
import json, sys, time, zenoh
config = zenoh.Config()
for name, value in (("mode", "peer"), ("listen/endpoints", [sys.argv[1]]), ("scouting/multicast/enabled", False)):
    config.insert_json5(name, json.dumps(value))
with zenoh.open(config) as session:
    ring = session.declare_subscriber("omnid/cmd/**", zenoh.handlers.RingChannel(16))
    queries = session.declare_queryable("omnid/@request/*", zenoh.handlers.RingChannel(16))
    print("ready", flush=True)
    time.sleep(3600)
"""


@contextmanager
def started(text: str, *words: str) -> Iterator[subprocess.Popen[str]]:
    """Run a program until the end of the block; yield when it is ready."""
    with subprocess.Popen(
        [sys.executable, "-P", "-c", text, *words], stdout=subprocess.PIPE, text=True, cwd=ROOT
    ) as process:
        try:
            assert process.stdout is not None and process.stdout.readline() == "ready\n"
            yield process
        finally:
            process.kill()


@contextmanager
def flood(port: int, key: str, rate_hz: float) -> Iterator[None]:
    """Send messages on a key, from SENDERS processes together."""
    payload = twist_stamped_cdr(1, "base_link", 0.1, 0.0)
    with ExitStack() as ends:
        for _ in range(SENDERS):
            ends.enter_context(
                started(FLOODER, f"tcp/127.0.0.1:{port}", f"omnid/{key}", str(rate_hz / SENDERS), payload.hex())
            )
        yield


def received_hz(port: int, key: str, rate_hz: float) -> float:
    """Return how many messages a second of such a flood arrive at a listener that only counts."""
    count = 0

    def add(_: zenoh.Sample) -> None:
        nonlocal count
        count += 1

    config = zenoh.Config()
    for name, value in (
        ("mode", "peer"),
        ("listen/endpoints", [f"tcp/127.0.0.1:{port}"]),
        ("scouting/multicast/enabled", False),
    ):
        config.insert_json5(name, json.dumps(value))
    with zenoh.open(config) as session:
        held = session.declare_subscriber("omnid/cmd/**", zenoh.handlers.Callback(add, indirect=False))
        with flood(port, key, rate_hz):
            time.sleep(1.0)
            begin, begin_s = count, time.monotonic()
            time.sleep(2.0)
            rate = (count - begin) / (time.monotonic() - begin_s)
        del held
    return rate


def pose_rate_hz(operator: Operator) -> float:
    """Return the poses that arrive a second."""
    begin, begin_s = len(operator.poses), time.monotonic()
    time.sleep(MEASURED_S)
    return (len(operator.poses) - begin) / (time.monotonic() - begin_s)


def run(recorded: Path, folder: Path, rate_hz: float, only: list[str]) -> int:
    """Measure a row for each key; return the number of keys on which the poses or the stop suffered."""
    failed, own = 0, folder / "floods"
    own.mkdir()
    sink_port = free_port()
    reached_hz = received_hz(free_port(), "cmd/imu", rate_hz)
    table = ResultTable(
        "faults_floods",
        "faults",
        "Poses and stops beside floods of messages",
        COLUMNS,
        continued=True,
        remarks=(
            f"{SENDERS} senders are asked for {rate_hz:.0f}/s and reach {reached_hz:.0f}/s at a counting listener.",
        ),
    )
    with robot(recorded, own) as (daemon, operator, _), started(SINK, f"tcp/127.0.0.1:{sink_port}"):
        for key in (key for key in KEYS if not only or any(word in key for word in only)):
            before_hz = pose_rate_hz(operator)
            with flood(sink_port, key, rate_hz):
                beside_hz = pose_rate_hz(operator)
            with flood(daemon.port, key, rate_hz):
                during_hz = pose_rate_hz(operator)
                stop_s = timed_stop(daemon.port)
            share = during_hz / beside_hz
            table.add(f"`{key}`", before_hz, beside_hz, during_hz, 100 * share, stop_s)
            failed += share < LEAST_SHARE or stop_s > LONGEST_STOP_S
    return failed
