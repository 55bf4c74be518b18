"""Processes that only compute: a busy machine for tests, faults and benchmarks."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from typing import Final

LOOP: Final = "while True: pass"


@contextmanager
def busy_processes(count: int) -> Iterator[None]:
    """Keep so many other processes busy in this block."""
    with ExitStack() as ends:
        for _ in range(count):
            process = ends.enter_context(subprocess.Popen([sys.executable, "-c", LOOP]))
            ends.callback(process.kill)
        yield
