"""Latencies of the live daemon: `python -m pytest -m benchmark -s tests/benchmark/test_live.py`; soak test: `-m slow`.

OMNID_BENCHMARK_S: duration of a measurement in s (60). OMNID_SOAK_MINUTES: duration of the soak test (2; 10: full).
The log is that of `tests/benchmark/live_daemon.py`.
"""

from __future__ import annotations

import os
import time
from pathlib import Path

import pytest

from tests.benchmark.live_daemon import HZ, daemon
from tests.benchmark.results import Column, ResultTable
from tests.busy import busy_processes
from tests.replay.live import Operator

MEASURE_S = float(os.environ.get("OMNID_BENCHMARK_S", "60"))
SOAK_S = 60 * float(os.environ.get("OMNID_SOAK_MINUTES", "2"))
LATEST_MS = 20.0  # largest lateness of the motor's tick, 99.9th percentile
MOTOR_HZ = 50.0
PERIOD_S = 5.0  # between two samples of the soak test
GROWTH_MB = 8.0  # allowed growth from the first half to the second: noise of the allocator
STAGES = ("lower", "upper", "pair", "dewarp", "odometry", "mapping", "bus", "bus-drive", "bus-map")


FIGURES = (
    "pose p50",
    "pose p99",
    "pose max",
    "wheel p50",
    "wheel p99",
    "wheel max",
    "tick p50",
    "tick p99",
    "tick p999",
    "tick max",
    "publishing cpu p50",
    "publishing cpu p99",
)
COLUMNS = (
    Column("images, busy processes per core"),
    *(Column(name, "ms", 1) for name in FIGURES),
    *map(Column, ("poses/s", "ticks", "missed", "lost_reports", "dropped", "load")),
)


def number(text: str) -> float | str | None:
    """Return a published figure as a number; what is none stays a text."""
    try:
        return float(text)
    except ValueError:
        return text or None


def figures(operator: Operator, load: float) -> dict[str, str]:
    """Return the measurements that the daemon has published."""
    odometry, wheels = operator.values("odometry"), operator.values("wheels")
    values = {f"pose {q}": odometry.get(f"capture_to_pose_{q}_ms", "") for q in ("p50", "p99", "max")}
    values |= {f"wheel {q}": wheels.get(f"capture_to_wheel_{q}_ms", "") for q in ("p50", "p99", "max")}
    values |= {f"tick {q}": wheels.get(f"tick_late_{q}_ms", "") for q in ("p50", "p99", "p999", "max")}
    missed, lost_reports = operator.values("stage motor")["missed"], wheels["lost_reports"]
    drops = {name: operator.values(f"stage {name}").get("dropped", "?") for name in STAGES}
    lost = " ".join(f"{name} {count}" for name, count in drops.items() if count != "0")
    values |= {f"publishing cpu {q}": operator.values("stage bus").get(f"cpu_{q}_ms", "") for q in ("p50", "p99")}
    return values | {
        "poses/s": odometry.get("rate_hz", ""),
        "ticks": wheels["sent"],
        "missed": missed,
        "lost_reports": lost_reports,
        "dropped": lost or "0",
        "load": f"{load:.1f}",
    }


@pytest.mark.benchmark
@pytest.mark.parametrize("per_core", [0, 1, 4], ids=["alone", "busy", "overloaded"])
@pytest.mark.parametrize("rate_hz", [10, 30])
def test_latencies_and_the_deadline_of_the_motor_tick(tmp_path: Path, rate_hz: int, per_core: int) -> None:
    with (
        busy_processes(per_core * (os.cpu_count() or 1)),
        daemon(tmp_path, rate_hz / float(HZ), f"motor.rate_hz={MOTOR_HZ}") as (_, operator, base),
    ):
        time.sleep(MEASURE_S)
        found = figures(operator, os.getloadavg()[0])
        assert base.line.base.errors == 0
    table = ResultTable("live", "speed", "Latency of the live daemon", COLUMNS, continued=True)
    table.add(f"{rate_hz} Hz, {per_core} busy", *(number(found[column.name]) for column in COLUMNS[1:]))
    assert float(found["tick p999"]) <= LATEST_MS


class Size(tuple[float, int, int]):
    """Resident memory [MB], file descriptors, threads."""

    @staticmethod
    def of(pid: int) -> Size:
        """Read them from /proc."""
        status = dict(line.split(":", 1) for line in Path(f"/proc/{pid}/status").read_text().splitlines())
        resident_mb = int(status["VmRSS"].split()[0]) / 1024
        return Size((resident_mb, len(os.listdir(f"/proc/{pid}/fd")), int(status["Threads"])))


@pytest.mark.slow
def test_memory_descriptors_and_threads_do_not_grow(tmp_path: Path) -> None:
    """Run 30 pairs a second with commands, maps and status reports on the bus."""
    with daemon(tmp_path, 3.0) as (process, operator, base):
        time.sleep(20)  # until caches, pools and the map of the repeated scene are full
        sizes = []
        deadline_s = time.monotonic() + SOAK_S
        while time.monotonic() < deadline_s:
            time.sleep(PERIOD_S)
            assert process.alive
            sizes.append(Size.of(process.process.pid))
        rate_hz, drives = operator.values("odometry")["rate_hz"], base.drives
    half = len(sizes) // 2
    before, after = sizes[:half], sizes[half:]
    megabytes = [size[0] for size in sizes]
    columns = (
        Column("time", "s", 0),
        Column("poses/s", "", 1),
        Column("poses"),
        *(Column(name, "MB", 1) for name in ("resident after 20 s", "after half", "at the end", "most")),
        Column("descriptors"),
        Column("threads"),
    )
    table = ResultTable("soak", "speed", "Memory of the live daemon", columns)
    table.add(
        SOAK_S,
        number(rate_hz),
        len(operator.poses),
        megabytes[0],
        megabytes[half],
        megabytes[-1],
        max(megabytes),
        *(", ".join(map(str, sorted({size[k] for size in sizes}))) for k in (1, 2)),
    )
    assert drives and max(size[0] for size in after) <= max(size[0] for size in before) + GROWTH_MB
    for index in (1, 2):
        assert max(size[index] for size in after) <= max(size[index] for size in before)
