"""Threads and locks for code that has no graph: outside of omnid.engine no module imports `threading`."""

from __future__ import annotations

import sys
import threading
import time
import traceback
from collections.abc import Callable
from typing import Final

from omnid.core.nanoseconds import S_PER_NS

Lock = threading.Lock
POLL_S: Final = (
    0.1  # longest wait without a look at what ends it: a signal in another thread does not wake the main one
)


def started(action: Callable[[], object], name: str) -> Callable[[float | None], bool]:
    """Call an action in a thread; return a function that waits for its end for so long [s], None: for any time.

    It returns whether the action has ended. The thread does not keep the program from ending; what it raises is lost.
    """
    thread = threading.Thread(target=action, name=name, daemon=True)
    thread.start()

    def has_ended(timeout_s: float | None) -> bool:
        thread.join(timeout_s)
        return not thread.is_alive()

    return has_ended


def sleep_until(due_ns: int, is_over: Callable[[], bool]) -> None:
    """Sleep until a time by CLOCK_MONOTONIC, or until is_over() returns True."""
    while not is_over() and (left_s := (due_ns - time.monotonic_ns()) * S_PER_NS) > 0:
        time.sleep(min(left_s, POLL_S))


class Poller:
    """Calls an action each period until it is closed; what the action raises is printed, and the calls go on."""

    def __init__(self, action: Callable[[], None], period_s: float, name: str) -> None:
        self._action, self._period_s = action, period_s
        self._closing = False
        self._thread = threading.Thread(target=self._run, name=name, daemon=True)
        self._thread.start()

    def close(self) -> None:
        """End the calls within a period; a running one ends first, unless this is it."""
        self._closing = True
        if threading.current_thread() is not self._thread:
            self._thread.join()

    def _run(self) -> None:
        while True:
            time.sleep(self._period_s)  # half the processor time of a wait for an event
            if self._closing:
                return
            try:
                self._action()
            except Exception:  # the thread is the only way in for stops: it must not end by a defect elsewhere
                traceback.print_exc(file=sys.stderr)
