"""Processor time of the whole daemon by its threads, over a minute: `python -m tests.benchmark.daemon`.

`omnid run` on a log that begins again at its end, with all stages, the bus, an operator who sends commands, and a
simulated motor controller. The share of a core is that of all threads of a name (omnid/diagnostics/threads_status.py).
Memory: the resident size at the end and the largest one.
The log is that of `tests/benchmark/live_daemon.py`; --rates are those at which its pairs are offered.
"""

from __future__ import annotations

import argparse
import os
import tempfile
import time
from pathlib import Path
from typing import Final

from omnid.diagnostics.threads_status import ThreadShare, shares, thread_times
from tests.benchmark.live_daemon import HZ, daemon
from tests.benchmark.results import Column, ResultTable
from tests.replay.live import Operator

LEAST_SHARE: Final = 0.002  # of a core; threads below it make one row
OTHERS: Final = "others"
ENDED: Final = "threads that ended"
COLUMNS: Final = (
    Column("rate, thread"),
    Column("threads"),
    Column("share of a core", "", 3),
    *(Column(name, "MB", 0) for name in ("resident", "most")),
    *(Column(name, "ms", 1) for name in ("pose p50", "pose p99")),
    Column("poses/s", "", 1),
)


def memory_mb(pid: int) -> tuple[float, float]:
    """Return the resident size now and the largest one."""
    status = dict(line.split(":", 1) for line in Path(f"/proc/{pid}/status").read_text().splitlines())
    return int(status["VmRSS"].split()[0]) / 1024, int(status["VmHWM"].split()[0]) / 1024


def process_time_s(pid: int) -> float:
    """Return the processor time of a process [s], with that of its threads that have ended."""
    user, system = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[11:13]
    return (int(user) + int(system)) / os.sysconf("SC_CLK_TCK")


def measure(table: ResultTable, rate_hz: float, seconds: float, warm_s: float, settings: list[str]) -> None:
    """Run the daemon at a rate of pairs, and add its rows."""
    with (
        tempfile.TemporaryDirectory() as folder,
        daemon(Path(folder), rate_hz / float(HZ), *settings) as (process, operator, _),
    ):
        pid = process.process.pid
        time.sleep(warm_s)
        before, before_s, start_s = thread_times(pid), process_time_s(pid), time.monotonic()
        time.sleep(seconds)
        after, after_s = thread_times(pid), process_time_s(pid)
        measured_s = time.monotonic() - start_s
        resident_mb, most_mb = memory_mb(pid)
        p50_ms, p99_ms, poses_hz = latencies(operator)
    by_name = shares(before, after, measured_s)
    whole = (after_s - before_s) / measured_s
    threads = sum(entry.threads for entry in by_name.values())
    table.add(f"{rate_hz:g} Hz: all", threads, whole, resident_mb, most_mb, p50_ms, p99_ms, poses_hz)
    small = [entry for entry in by_name.values() if entry.share < LEAST_SHARE]
    rows = {name: entry for name, entry in by_name.items() if entry.share >= LEAST_SHARE}
    rows[OTHERS] = ThreadShare(sum(entry.threads for entry in small), sum(entry.share for entry in small))
    rows[ENDED] = ThreadShare(0, whole - sum(entry.share for entry in by_name.values()))
    for name, entry in rows.items():
        table.add(f"{rate_hz:g} Hz: {name}", entry.threads, entry.share, None, None, None, None, None)


def latencies(operator: Operator) -> tuple[float | None, float | None, float | None]:
    """Return median and 99th percentile from capture to pose [ms], and the poses a second, as the daemon says them."""
    odometry = operator.values("odometry")
    found = [odometry.get(name, "") for name in ("capture_to_pose_p50_ms", "capture_to_pose_p99_ms", "rate_hz")]
    p50_ms, p99_ms, rate_hz = (float(text) if text else None for text in found)
    return p50_ms, p99_ms, rate_hz


def main() -> None:
    """Measure and print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--rates", type=float, nargs="+", default=[10.0, 30.0], metavar="HZ")
    parser.add_argument("--seconds", type=float, default=60.0, help="of the measurement at each rate")
    parser.add_argument("--warm-s", type=float, default=15.0, help="before it: until caches and maps are full")
    parser.add_argument("--set", action="append", default=[], metavar="SECTION.KEY=VALUE", help="a daemon's setting")
    options = parser.parse_args()
    table = ResultTable("daemon", "speed", "Processor time of the whole daemon by threads", COLUMNS)
    for rate_hz in options.rates:
        measure(table, rate_hz, options.seconds, options.warm_s, options.set)


if __name__ == "__main__":
    main()
