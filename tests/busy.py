"""A busy machine for tests, faults and benchmarks: processes that only compute, and one that gets a share of a core."""

from __future__ import annotations

import signal
import subprocess
import sys
import threading
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


@contextmanager
def stopped_by_turns(process: subprocess.Popen[str], running_s: float, stopped_s: float) -> Iterator[None]:
    """Let a process run and stop by turns in this block, as a scheduler does that shares its core."""
    ends = threading.Event()

    def stop_and_go() -> None:
        while not ends.wait(running_s):
            process.send_signal(signal.SIGSTOP)
            ends.wait(stopped_s)
            process.send_signal(signal.SIGCONT)

    thread = threading.Thread(target=stop_and_go)
    thread.start()
    try:
        yield
    finally:
        ends.set()
        thread.join()
