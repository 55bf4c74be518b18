"""Waiting on a loaded machine, for what threads and processes do."""

from __future__ import annotations

import subprocess
import time
from collections.abc import Callable

PATIENCE_S = 60.0  # timeout of a wait; not a measured time


def wait_until(
    happens: Callable[[], object], what: str = "it", patience_s: float = PATIENCE_S, *, pause_s: float = 0.02
) -> None:
    """Return once it happens; raise AssertionError after the timeout."""
    deadline_s = time.monotonic() + patience_s
    while not happens():
        assert time.monotonic() < deadline_s, f"{what} did not happen within {patience_s:g} s"
        time.sleep(pause_s)


def ended(process: subprocess.Popen[str], number: int) -> tuple[int, str]:
    """Send a signal to a process; return its exit code and stderr."""
    process.send_signal(number)
    _, err = process.communicate(timeout=PATIENCE_S)
    return process.returncode, err
