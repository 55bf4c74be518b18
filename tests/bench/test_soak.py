"""Soak test of the live daemon: `python -m pytest -m slow tests/bench`; OMNID_SOAK_MINUTES: how long (2)."""

from __future__ import annotations

import os
import time
from pathlib import Path

import pytest

from tests.bench.daemon import daemon, status

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
