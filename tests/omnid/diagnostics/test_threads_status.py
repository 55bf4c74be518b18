"""The times of threads are those that they have used, by names that say whose they are."""

from __future__ import annotations

import threading
import time

from omnid.diagnostics.threads_status import (
    LIBRARIES,
    MAIN,
    ThreadsStatus,
    thread_times,
)
from omnid.engine.realtime import name_thread
from omnid.transport.status_names import Key

BURNT_S = 0.15
TICK_S = 0.03  # the kernel counts ticks of 0.01 s, in the program and in the kernel, and rounds both down


def burning(name: str, end: threading.Event) -> threading.Thread:
    """Return a running thread that has used BURNT_S and waits for the end; an empty name: it has none of its own."""
    burnt = threading.Event()

    def burn() -> None:
        if name:
            name_thread(name)
        while time.thread_time() < BURNT_S:
            pass
        burnt.set()
        end.wait()

    thread = threading.Thread(target=burn)
    thread.start()
    burnt.wait()
    return thread


def test_the_status_has_the_shares_of_running_threads_by_name() -> None:
    status, end = ThreadsStatus(), threading.Event()
    named, unnamed = burning("burn (1) x", end), burning("", end)  # a name with what ends the field of names
    times, values = thread_times(), status().values
    end.set()
    for thread, name in ((named, "burn (1) x"), (unnamed, LIBRARIES)):
        thread.join()
        assert thread.native_id is not None and times[thread.native_id].name == name
        assert times[thread.native_id].used_s >= BURNT_S - TICK_S
    assert {MAIN, "burn (1) x", LIBRARIES} <= values.keys() and float(values["burn (1) x"]) > 0
    by_name = [float(share) for name, share in values.items() if name != Key.ALL]
    assert abs(float(values[Key.ALL]) - sum(by_name)) < 0.001 * (len(by_name) + 1)
