"""Processes of tests, and waiting on a loaded machine for what they and threads do."""

from __future__ import annotations

import os
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path

ROOT = Path(__file__).parents[1]
OMNID = (sys.executable, "-m", "omnid")
PATIENCE_S = 60.0  # timeout of a wait; not a measured time


def wait_until(
    condition: Callable[[], object], what: str = "it", patience_s: float = PATIENCE_S, *, pause_s: float = 0.02
) -> None:
    """Return once the condition is true; raise AssertionError, with what was waited for, after the timeout."""
    deadline_s = time.monotonic() + patience_s
    while not condition():
        assert time.monotonic() < deadline_s, f"{what} did not happen within {patience_s:g} s"
        time.sleep(pause_s)


@contextmanager
def running(
    command: Sequence[object], environment: Mapping[str, str] | None = None, *, stdin: int | None = None
) -> Iterator[subprocess.Popen[str]]:
    """Yield a process of this source tree, whose output is piped; it is killed at the end of the block."""
    words, pipe = [*map(str, command)], subprocess.PIPE
    variables = os.environ | {"PYTHONPATH": str(ROOT), **(environment or {})}
    with subprocess.Popen(words, stdin=stdin, stdout=pipe, stderr=pipe, text=True, env=variables) as process:
        try:
            yield process
        finally:
            process.kill()


def ended(process: subprocess.Popen[str], number: int) -> tuple[int, str]:
    """Send a signal to a process; return its exit code and stderr."""
    process.send_signal(number)
    _, err = process.communicate(timeout=PATIENCE_S)
    return process.returncode, err
