"""`omnid batch` on many short logs: one and two programs at a time, and two dask workers of which one is killed.

`python -m tests.benchmark.batch [--logs 50]`; dask needs the extra `fleet`. The logs are starts of the sample of
different lengths: recordings that were cut. Each est.txt and cloud.ply is compared with that of the first series.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import tempfile
import threading
import time
from collections import Counter
from importlib.resources import files
from importlib.util import find_spec
from pathlib import Path

from omnid.batch.tables import CSV_FILE
from tests.benchmark.results import Column, ResultTable
from tests.omnid.batch.dask_cluster import dask_cluster

SAMPLE = Path(str(files("omnid.sample") / "log.mcap"))
FIRST_BYTES, STEP_BYTES = 600_000, 20_000
KILLED_AFTER_S = 8.0


def batch(logs: Path, out: Path, *words: str) -> tuple[float, Counter[str], int]:
    """Run a batch; return its time, the results by state, and the number of attempts beyond the first."""
    start_s = time.monotonic()
    subprocess.run(
        [sys.executable, "-m", "omnid", "batch", str(logs), "--out", str(out), *words], check=True, capture_output=True
    )
    results = [json.loads(path.read_text()) for path in out.glob("*/result.json")]
    assert (out / CSV_FILE).exists()
    return (
        time.monotonic() - start_s,
        Counter(result["status"] for result in results),
        sum(result["attempts"] - 1 for result in results),
    )


def same(first: Path, other: Path) -> bool:
    """True if both series have the same trajectories and clouds."""
    return all(
        (other / path.relative_to(first)).read_bytes() == path.read_bytes()
        for name in ("est.txt", "cloud.ply")
        for path in first.glob(f"*/{name}")
    )


def text(states: Counter[str]) -> str:
    """Return the numbers of results by state."""
    return ", ".join(f"{number} {state}" for state, number in states.items())


def main() -> None:
    """Measure and print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--logs", type=int, default=50)
    count = parser.parse_args().logs
    columns = (
        Column(f"{count} logs"),
        Column("time", "s", 0),
        Column("results"),
        Column("repeated"),
        Column("same bytes"),
    )
    table = ResultTable("batch", "speed", "Many logs", columns)
    with tempfile.TemporaryDirectory() as folder:
        top = Path(folder)
        logs = top / "logs"
        logs.mkdir()
        sample = SAMPLE.read_bytes()
        for number in range(count):
            (logs / f"{number:03d}.mcap").write_bytes(sample[: FIRST_BYTES + STEP_BYTES * number])
        for jobs in (1, 2):
            taken_s, states, repeated = batch(logs, top / f"jobs{jobs}", "--jobs", str(jobs))
            equal = same(top / "jobs1", top / f"jobs{jobs}")
            table.add(f"{jobs} at a time", taken_s, text(states), repeated, equal)
        if find_spec("distributed") is None:
            return
        with dask_cluster(top) as (address, workers):
            threading.Timer(KILLED_AFTER_S, workers[0].kill).start()
            taken_s, states, repeated = batch(logs, top / "dask", "--dask", address)
        equal = same(top / "jobs1", top / "dask")
        table.add(f"two dask workers, one killed after {KILLED_AFTER_S:g} s", taken_s, text(states), repeated, equal)


if __name__ == "__main__":
    main()
