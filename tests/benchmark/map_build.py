"""A map of several logs: each in the map of those before, side by side by several programs, and by two dask workers.

`python -m tests.benchmark.map_build [--logs 6] [--workers 1 2 4] [--drives DIR]`; dask needs the extra `fleet`. The
logs are drives through one rendered corridor, on other paths (two_laps), and for the second half of the table starts of
the sample of different lengths. --drives keeps what was rendered, and reads it the next time. Each figure is the least
of --repeats runs, which take turns.
"""

from __future__ import annotations

import argparse
import os
import resource
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from importlib.util import find_spec
from multiprocessing import get_context
from pathlib import Path

from omnid.config import load_config
from omnid.formats.place_file import read_places
from omnid.runs.place_maps import new_places
from tests.benchmark.batch import SAMPLE
from tests.benchmark.results import Column, ResultTable
from tests.omnid.batch.dask_cluster import dask_cluster
from tests.simulation import paths, write_log
from tests.simulation.closed_worlds import ring, two_laps_path
from tests.simulation.recipes import mild_rig

STEP_BYTES = 40_000  # between the lengths of two logs of the sample
PAIRS, SIZE_PX = 300, 384  # of a drive, which takes 30 s
# As of an installed package, whose modules are compiled: some machines forbid that in a tree of sources.
ENVIRONMENT = {name: value for name, value in os.environ.items() if name != "PYTHONDONTWRITEBYTECODE"}


@dataclass(frozen=True, slots=True)
class Built:
    """A map, and what it took to build it."""

    time_s: float
    processor_s: float  # processor time of all programs
    output: Path

    @property
    def keyframes(self) -> int:
        """The number of keyframes of the map."""
        places, _ = read_places(self.output, new_places(load_config(None, []).places))
        return len(places)


def built(logs: Sequence[Path], output: Path, *words: str) -> Built:
    """Build a map."""
    start_s, before = time.monotonic(), resource.getrusage(resource.RUSAGE_CHILDREN)
    command = [sys.executable, "-m", "omnid", "map", "build", *map(str, logs), "-o", str(output), "--quiet", *words]
    subprocess.run([*command, "--replace"], check=True, capture_output=True, env=ENVIRONMENT)
    time_s, after = time.monotonic() - start_s, resource.getrusage(resource.RUSAGE_CHILDREN)
    processor_s = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
    return Built(time_s, processor_s, output)


def render_drive(folder: Path, seed: int, number: int) -> None:
    """Render one of the drives through the corridor of a seed, unless it is there."""
    if not (folder / "log.mcap").exists():
        poses = paths.vibrate(two_laps_path(seed + number, PAIRS), seed + number, 0.2)
        write_log(folder, mild_rig(seed, SIZE_PX), poses, ring(seed), seed=seed + number)


def rendered_drives(top: Path, seed: int, count: int) -> list[Path]:
    """Return the folders of drives, which are rendered."""
    folders = [top / str(number) for number in range(count)]
    with ProcessPoolExecutor(mp_context=get_context("spawn")) as pool:
        list(pool.map(render_drive, folders, [seed] * count, range(count)))
    return folders


def starts_of_sample(top: Path, count: int) -> list[Path]:
    """Return logs that are starts of the sample."""
    sample, logs = SAMPLE.read_bytes(), [top / f"{number:03d}.mcap" for number in range(count)]
    for number, log in enumerate(logs):
        log.write_bytes(sample[: len(sample) - STEP_BYTES * number])
    return logs


def measure(
    table: ResultTable, name: str, logs: Sequence[Path], words: Sequence[str], args: argparse.Namespace
) -> None:
    """Add the rows of some logs."""
    with tempfile.TemporaryDirectory() as folder:
        top = Path(folder)
        runs: dict[int, list[Built]] = {count: [] for count in args.workers}
        for number in range(args.repeats):
            for count, done in runs.items():
                done.append(built(logs, top / f"{count}_{number}.omap", "--jobs", str(count), *words))
        side_by_side = {run.output.read_bytes() for count, done in runs.items() if count > 1 for run in done}
        for count, done in runs.items():
            least_s, processor_s = min(run.time_s for run in done), min(run.processor_s for run in done)
            same = None if count == 1 else len(side_by_side) == 1
            table.add(f"{name}, {count} at a time", least_s, processor_s, done[0].keyframes, same)
        if find_spec("distributed") is not None:
            with dask_cluster(top) as (address, _):
                run = built(logs, top / "dask.omap", "--dask", address, *words)
            same = run.output.read_bytes() in side_by_side if side_by_side else None
            table.add(f"{name}, two dask workers", run.time_s, None, run.keyframes, same)


def main() -> None:
    """Measure and print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--logs", type=int, default=6)
    parser.add_argument("--workers", type=int, nargs="+", default=[1, 2, 4])
    parser.add_argument("--repeats", type=int, default=2)
    parser.add_argument("--seed", type=int, default=604)
    parser.add_argument("--drives", type=Path, help="folder for the rendered drives; default: one that is removed")
    args = parser.parse_args()
    columns = (
        Column(f"{args.logs} logs"),
        Column("time", "s", 1),
        Column("processor time", "s", 1),
        Column("keyframes"),
        Column("same bytes with any number of workers"),
    )
    with tempfile.TemporaryDirectory() as folder:
        top = Path(folder)
        drives = rendered_drives(args.drives or top / "drives", args.seed, args.logs)
        short = starts_of_sample(top, args.logs)
        built(short[-1:], top / "first.omap")  # compiles what is compiled once
        table = ResultTable("map_build", "speed", "A map of several logs", columns)
        table.seeds = [("two_laps", args.seed + number) for number in range(args.logs)]
        rig = "--rig", str(drives[0] / "rig.toml")
        measure(table, f"drives of {PAIRS / 10:.0f} s", [drive / "log.mcap" for drive in drives], rig, args)
        measure(table, "starts of the sample, 10 s", short, (), args)


if __name__ == "__main__":
    main()
