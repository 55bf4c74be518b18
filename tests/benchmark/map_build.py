"""A map of several logs: each in the map of those before, side by side by two programs, and by two dask workers.

`python -m tests.benchmark.map_build [--logs 8]`; dask needs the extra `fleet`. The logs are starts of the sample of
different lengths, so that all of them share a place.
"""

from __future__ import annotations

import argparse
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from importlib.util import find_spec
from pathlib import Path

from omnid.config import load_config
from omnid.formats.place_file import read_places
from omnid.runs.place_maps import new_places
from tests.benchmark.batch import SAMPLE, dask
from tests.benchmark.results import Column, ResultTable

STEP_BYTES = 40_000  # between the lengths of two logs


def built(logs: Sequence[Path], output: Path, *words: str) -> tuple[float, int]:
    """Build a map; return the time and the number of its keyframes."""
    start_s = time.monotonic()
    command = [sys.executable, "-m", "omnid", "map", "build", *map(str, logs), "-o", str(output), "--quiet", *words]
    subprocess.run(command, check=True, capture_output=True)
    taken_s = time.monotonic() - start_s
    places, _ = read_places(output, new_places(load_config(None, []).places))
    return taken_s, len(places)


def main() -> None:
    """Measure and print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--logs", type=int, default=8)
    count = parser.parse_args().logs
    columns = Column(f"{count} logs"), Column("time", "s", 1), Column("keyframes")
    table = ResultTable("map_build", "speed", "A map of several logs", columns)
    with tempfile.TemporaryDirectory() as folder:
        top = Path(folder)
        sample = SAMPLE.read_bytes()
        logs = [top / f"{number:03d}.mcap" for number in range(count)]
        for number, log in enumerate(logs):
            log.write_bytes(sample[: len(sample) - STEP_BYTES * number])
        for jobs in (1, 2):
            table.add(f"{jobs} at a time", *built(logs, top / f"{jobs}.omap", "--jobs", str(jobs)))
        if find_spec("distributed") is None:
            return
        with dask(top) as (address, _):
            table.add("two dask workers", *built(logs, top / "dask.omap", "--dask", address))


if __name__ == "__main__":
    main()
