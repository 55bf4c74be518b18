"""Threads and locks for code that has no graph: outside of omnid.engine no module imports `threading`."""

from __future__ import annotations

import sys
import threading
import time
import traceback
from collections.abc import Callable
from typing import Final

from omnid.core.nanoseconds import NS_PER_S, S_PER_NS

Lock = threading.Lock
POLL_S: Final = 0.1  # longest wait without a look at what ends it, as a signal in another thread wakes no main thread


def started(action: Callable[[], object], name: str) -> threading.Thread:
    """Call an action in a thread, which does not keep the program from ending; what it raises is printed."""
    thread = threading.Thread(target=action, name=name, daemon=True)
    thread.start()
    return thread


def sleep_until(due_ns: int, is_over: Callable[[], bool]) -> None:
    """Sleep until a time by CLOCK_MONOTONIC, or until is_over() returns True."""
    while not is_over() and (left_s := (due_ns - time.monotonic_ns()) * S_PER_NS) > 0:
        time.sleep(min(left_s, POLL_S))  # half the processor time of a wait for an event


class Poller:
    """Calls an action each period until it is closed; what the action raises is printed, and the calls go on."""

    def __init__(self, action: Callable[[], object], period_s: float, name: str) -> None:
        self._action, self._period_ns = action, round(period_s * NS_PER_S)
        self._closing = False
        self._thread = started(self._run, name)

    def close(self) -> None:
        """End the calls; a running one ends first, unless this is it."""
        self._closing = True
        if threading.current_thread() is not self._thread:
            self._thread.join()

    def _run(self) -> None:
        while not self._closing:
            due_ns = time.monotonic_ns() + self._period_ns
            try:
                self._action()
            except Exception:  # the thread is the only way in for stops: it must not end by a defect elsewhere
                traceback.print_exc(file=sys.stderr)
            sleep_until(due_ns, lambda: self._closing)
