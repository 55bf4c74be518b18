"""Resident memory of the whole daemon by what it holds: `python -m tests.benchmark.daemon_memory`.

The daemon is that of `tests/benchmark/daemon.py`. The system's mappings are added up (proc(5), smaps): what malloc
gives, which is numpy's arrays, larger objects of Python, LLVM's and zenoh's; other memory without a file, which is
small objects of Python and the stacks of threads; and the files of each package.
"""

from __future__ import annotations

import argparse
import re
import tempfile
import time
from collections import Counter
from pathlib import Path
from typing import Final

from tests.benchmark.daemon import memory_mb
from tests.benchmark.live_daemon import HZ, daemon
from tests.benchmark.results import Column, ResultTable

LEAST_MB: Final = 2.0  # smaller files make one row
MAPPING: Final = re.compile(r"[0-9a-f]+-[0-9a-f]+ \S+ \S+ \S+ \d+ *(.*)")
PACKAGE: Final = re.compile(r".*/site-packages/([^/]+?)(?:\.libs)?/")
MALLOC, OBJECTS, OTHERS = "malloc: arrays, LLVM, zenoh", "small objects of Python, stacks", "other files"


def resident_mb(smaps: str) -> dict[str, float]:
    """Return the resident sizes [MB] by kind and package, the largest first; smaps: the file's text."""
    found: Counter[str] = Counter()
    kind = ""
    for line in smaps.splitlines():
        if mapping := MAPPING.match(line):
            kind = _kind(mapping[1])
        elif line.startswith("Rss:"):
            found[kind] += int(line.split()[1]) / 1024
    return dict(found.most_common())


def _kind(name: str) -> str:
    if not name.startswith("/"):
        return MALLOC if name == "[heap]" else OBJECTS
    package = PACKAGE.match(name)
    return f"files of {package[1]}" if package else "files of Python and the system"


def main() -> None:
    """Measure and print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--rates", type=float, nargs="+", default=[10.0, 30.0], metavar="HZ")
    parser.add_argument("--after-s", type=float, default=60.0, help="from the first pose to the reading")
    options = parser.parse_args()
    columns = (Column("rate, what"), Column("resident", "MB", 0), Column("most", "MB", 0))
    table = ResultTable("daemon_memory", "speed", "Memory of the whole daemon", columns)
    for rate_hz in options.rates:
        with tempfile.TemporaryDirectory() as work, daemon(Path(work), rate_hz / float(HZ)) as (process, _, _):
            time.sleep(options.after_s)
            pid = process.process.pid
            smaps, (now_mb, most_mb) = Path(f"/proc/{pid}/smaps").read_text(), memory_mb(pid)
        table.add(f"{rate_hz:g} Hz: all", now_mb, most_mb)
        found = resident_mb(smaps)
        for kind, mb in found.items():
            if mb >= LEAST_MB:
                table.add(f"{rate_hz:g} Hz: {kind}", mb, None)
        table.add(f"{rate_hz:g} Hz: {OTHERS}", sum(mb for mb in found.values() if mb < LEAST_MB), None)


if __name__ == "__main__":
    main()
