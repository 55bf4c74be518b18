"""Benchmarks can be imported, as most are run by hand only; the soak test of the live daemon runs for minutes."""

from __future__ import annotations

import os
import subprocess
import sys
import time
from pathlib import Path

import pytest

from tests.bench.daemon import daemon, status

ROOT = Path(__file__).parents[2]


def test_each_module_can_be_imported() -> None:
    """In a process of its own: some set what all of a process share."""
    files = list((ROOT / "tests" / "bench").rglob("*.py"))
    names = [".".join(file.relative_to(ROOT).with_suffix("").parts) for file in files if not file.stem.startswith("_")]
    assert len(names) > 20
    program = "import importlib, sys\nfor name in sys.argv[1:]: importlib.import_module(name)"
    done = subprocess.run([sys.executable, "-c", program, *names], cwd=ROOT, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr.splitlines()[-1]


SOAK_S = 60 * float(os.environ.get("OMNID_SOAK_MINUTES", "2"))
PERIOD_S = 5.0  # between two samples
GROWTH_KB = 8 * 1024  # allowed growth from the first half to the second: noise of the allocator


@pytest.mark.slow
def test_memory_descriptors_and_threads_do_not_grow(tmp_path: Path) -> None:
    """Run 30 pairs a second with commands, maps and status reports on the bus."""
    with daemon(tmp_path, 3.0) as (process, _, base):
        time.sleep(20)  # until caches, pools and the map of the repeated scene are full
        pid, sizes = process.process.pid, []
        deadline_s = time.monotonic() + SOAK_S
        while time.monotonic() < deadline_s:
            time.sleep(PERIOD_S)
            assert process.alive
            found = status(pid)
            sizes.append((found["VmRSS"], len(os.listdir(f"/proc/{pid}/fd")), found["Threads"]))
        drives = base.drives
    half = len(sizes) // 2
    (before_kb, *before), (after_kb, *after) = (
        map(max, zip(*part, strict=True)) for part in (sizes[:half], sizes[half:])
    )
    assert drives and after_kb <= before_kb + GROWTH_KB
    assert after <= before
