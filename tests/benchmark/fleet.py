"""Many robots behind one router: losses, latencies, processor time of the router.

`python -m tests.benchmark.fleet [--robots 50] [--hz 10] [--seconds 20]`. Each robot publishes what a daemon does: a
pose with its attachment, /tf and pose at the given rate, a status each second. They share some processes, the router
and the listener have their own. Everything runs on this machine: latency is from publishing to the arrival.
"""

from __future__ import annotations

import argparse
import multiprocessing.synchronize
import os
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import zenoh

from omnid.transport import codec
from omnid.transport.bus import Bus, BusConfig
from omnid.transport.client_session import open_client
from omnid.transport.pose_attachment import PoseAttachment
from omnid.transport.records import DiagnosticStatus
from tests.benchmark.results import Column, ResultTable
from tests.omnid.transport.bus_fixtures import ROUTER, free_endpoint

ROBOTS_IN_A_PROCESS = 10
STATUSES = 25  # parts of a robot in each status


def robots(names: list[str], endpoint: str, hz: float, count: int, start: multiprocessing.synchronize.Barrier) -> None:
    """Publish count poses of each robot."""
    buses = [Bus(BusConfig(robot=name, listen=(), connect=(endpoint,))) for name in names]
    status = codec.diagnostics_cdr(
        10**18, [DiagnosticStatus(f"part {n}", 0, "good", {"value": "1.5"}) for n in range(STATUSES)]
    )
    pose = codec.pose_stamped_cdr(10**18, np.eye(4))
    start.wait()
    begin_s = time.monotonic()
    for number in range(count):
        for index, bus in enumerate(buses):
            due_s = begin_s + (number + index / len(buses)) / hz
            time.sleep(max(0.0, due_s - time.monotonic()))
            now_ns = time.time_ns()
            bus.publish(
                "odom",
                codec.odometry_cdr(now_ns, np.eye(4), np.eye(6), np.zeros(6), np.eye(6)),
                PoseAttachment(number, "tracking", 0, 50, 60, now_ns).to_bytes(),
            )
            bus.publish("pose", pose)
            bus.publish("/tf", codec.transform_cdr(now_ns, []))
            if number % max(1, round(hz)) == 0:
                bus.publish("status", status)
    time.sleep(1.0)  # the last messages leave
    for bus in buses:
        bus.close()


def cpu_s(pid: int) -> float:
    """Return the processor time of a process."""
    fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


def main() -> None:
    """Measure and print a row."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--robots", type=int, default=50)
    parser.add_argument("--hz", type=float, default=10.0)
    parser.add_argument("--seconds", type=float, default=20.0)
    args = parser.parse_args()
    endpoint, count = free_endpoint(), round(args.hz * args.seconds)
    with subprocess.Popen([sys.executable, "-c", ROUTER, endpoint], stdout=subprocess.PIPE) as router:
        assert router.stdout is not None
        router.stdout.readline()
        latencies_s: list[float] = []

        def on_sample(sample: zenoh.Sample) -> None:
            assert sample.attachment is not None
            sent_ns = PoseAttachment.from_bytes(sample.attachment.to_bytes()).sent_ns
            latencies_s.append((time.time_ns() - sent_ns) * 1e-9)

        with open_client(BusConfig(connect=(endpoint,)), 5.0) as session:
            subscriber = session.declare_subscriber("**/odom", on_sample)
            names = [f"robot{number}" for number in range(args.robots)]
            groups = [names[at : at + ROBOTS_IN_A_PROCESS] for at in range(0, len(names), ROBOTS_IN_A_PROCESS)]
            spawn = multiprocessing.get_context("spawn")  # a fork has zenoh's locks, but not its threads
            start = spawn.Barrier(len(groups) + 1)
            processes = [
                spawn.Process(target=robots, args=(group, endpoint, args.hz, count, start)) for group in groups
            ]
            for process in processes:
                process.start()
            start.wait()
            before_s, begin_s = cpu_s(router.pid), time.monotonic()
            for process in processes:
                process.join()
            router_share = (cpu_s(router.pid) - before_s) / (time.monotonic() - begin_s)
            subscriber.undeclare()
        router.kill()
    sent = count * args.robots
    p50, p99 = (1e3 * float(np.percentile(latencies_s, part)) for part in (50, 99))
    columns = (
        Column("robots"),
        Column("poses/s each"),
        Column("sent"),
        Column("received"),
        Column("latency p50", "ms", 1),
        Column("latency p99", "ms", 1),
        Column("router, of one core", "%", 0),
    )
    table = ResultTable("fleet", "speed", "Many robots behind one router", columns)
    table.add(args.robots, args.hz, sent, len(latencies_s), p50, p99, 100 * router_share)


if __name__ == "__main__":
    main()
