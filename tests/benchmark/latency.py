"""Times from the stamp of a pair until a client has its pose, as a histogram: `python -m tests.benchmark.latency`.

`omnid run` plays the sample with a simulated motor controller and an operator who drives (`live_daemon.py`). The first
seconds are left out: the start, and the first pairs, of which the rig is examined. The log begins again every 10 s of
its own time: there the pose is lost and found.
"""

from __future__ import annotations

import argparse
import os
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray

from tests.benchmark.live_daemon import HZ, daemon
from tests.benchmark.results import Cell, Column, ResultTable
from tests.busy import busy_processes
from tests.replay.live import Operator

FIRST_S: Final = 5.0  # after the first pose, left out
BORDERS_MS: Final = (15, 30, 45, 60, 90, 120, 250)
COLUMNS: Final = (
    Column("images, busy processes per core"),
    Column("poses"),
    *(Column(f"below {border_ms} ms", "%", 1) for border_ms in BORDERS_MS),
    Column("p50", "ms", 1),
    Column("p99", "ms", 1),
)


def received_ms(operator: Operator, seconds: float) -> list[float]:
    """Return the latencies of the poses that an operator receives in so long a time."""
    found: list[float] = []
    until, seen = time.monotonic() + seconds, len(operator.poses)
    while time.monotonic() < until:
        time.sleep(0.001)
        now_ns, new = time.time_ns(), operator.poses[seen:]
        found += [1e-6 * (now_ns - pose.stamp_ns) for pose in new]
        seen += len(new)
    return found


def row(name: str, latencies_ms: Sequence[float]) -> list[Cell]:
    """Return the row of one run; the shares are those of all poses below a time."""
    found: NDArray[np.float64] = np.array(latencies_ms)
    shares = [100 * float((found < border_ms).mean()) for border_ms in BORDERS_MS]
    return [name, len(found), *shares, *np.percentile(found, (50, 99)).tolist()]


def measure(rate_hz: float, per_core: int, seconds: float) -> list[float]:
    """Return the latencies [ms] at a rate beside computing processes."""
    with (
        busy_processes(per_core * (os.cpu_count() or 1)),
        tempfile.TemporaryDirectory() as folder,
        daemon(Path(folder), rate_hz / float(HZ)) as (_, operator, _),
    ):
        time.sleep(FIRST_S)
        return received_ms(operator, seconds)


def main() -> None:
    """Measure and print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--rates", type=float, nargs="+", default=[10.0, 30.0], metavar="HZ")
    parser.add_argument("--busy", type=int, nargs="+", default=[0, 1], metavar="PER_CORE")
    parser.add_argument("--seconds", type=float, default=30.0)
    args = parser.parse_args()
    table = ResultTable("latency", "speed", "From the stamp of a pair to its pose at a client", COLUMNS)
    for rate_hz in args.rates:
        for per_core in args.busy:
            table.add(*row(f"{rate_hz:g} Hz, {per_core} busy", measure(rate_hz, per_core, args.seconds)))


if __name__ == "__main__":
    main()
