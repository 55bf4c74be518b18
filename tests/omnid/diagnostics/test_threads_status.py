"""The times of threads are those that they have used, by names that say whose they are."""

from __future__ import annotations

import os
import threading
import time

from omnid.diagnostics.threads_status import (
    LIBRARIES,
    MAIN,
    MOST_THREADS,
    ThreadShare,
    ThreadShares,
    ThreadsStatus,
    ThreadTime,
    shares,
    thread_times,
)
from omnid.engine.realtime import name_thread
from omnid.transport.status_names import Key
from tests.waiting import wait_until

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


def test_reads_names_and_times_of_running_threads() -> None:
    reader, end = ThreadShares(), threading.Event()
    named, unnamed = burning("burn (1) x", end), burning("", end)  # a name with what ends the field of names
    times, found = thread_times(), reader()
    end.set()
    for thread in (named, unnamed):
        thread.join()
        assert thread.native_id is not None and times[thread.native_id].used_s >= BURNT_S - TICK_S
        wait_until(lambda ended=thread.native_id: ended not in thread_times(), "the end of the thread in the kernel")
    assert times[named.native_id or 0].name == "burn (1) x" and times[unnamed.native_id or 0].name == LIBRARIES
    assert times[os.getpid()].name == MAIN
    assert found["burn (1) x"].threads == 1 and 0 < found["burn (1) x"].share < os.cpu_count()


def test_adds_up_the_threads_of_a_name() -> None:
    before = {1: ThreadTime("pool", 1.0), 2: ThreadTime("odometry", 2.0)}
    after = {1: ThreadTime("pool", 1.5), 2: ThreadTime("odometry", 6.0), 3: ThreadTime("pool", 0.5)}
    assert shares(before, after, 10.0) == {"odometry": ThreadShare(1, 0.4), "pool": ThreadShare(2, 0.1)}


def test_an_id_that_is_used_again_begins_at_zero() -> None:
    assert shares({7: ThreadTime("old", 5.0)}, {7: ThreadTime("new", 1.0)}, 2.0) == {"new": ThreadShare(1, 0.5)}


def test_there_are_none_of_a_process_that_has_ended() -> None:
    assert thread_times(2**22 + 1) == {}, "above the largest id of a process"


def test_the_status_has_the_share_of_all_threads_and_the_largest_by_name() -> None:
    status, end = ThreadsStatus(), threading.Event()
    started = [burning(f"burner {number}", end) for number in range(2)]
    values = status().values
    end.set()
    for thread in started:
        thread.join()
    by_name = {name: float(share) for name, share in values.items() if name != Key.ALL}
    assert {"burner 0", "burner 1", MAIN} <= by_name.keys() and len(by_name) <= MOST_THREADS
    assert abs(float(values[Key.ALL]) - sum(by_name.values())) < 0.001 * (len(by_name) + 1)
    assert min(by_name["burner 0"], by_name["burner 1"]) > 0
