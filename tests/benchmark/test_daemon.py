"""The times of threads that the benchmark of the daemon reads are those that the threads have used."""

from __future__ import annotations

import os
import threading
import time

from omnid.engine.realtime import name_thread
from tests.benchmark.daemon import ThreadTime, process_time_s, shares, thread_times

BURNT_S = 0.15


def test_reads_names_and_times_of_running_threads() -> None:
    before_s = process_time_s(os.getpid())
    burnt, end = threading.Event(), threading.Event()

    def burn() -> None:
        name_thread("burn (1) x")  # a name with what ends the field of names
        while time.thread_time() < BURNT_S:
            pass
        burnt.set()
        end.wait()

    thread = threading.Thread(target=burn)
    thread.start()
    burnt.wait()
    times = thread_times(os.getpid())
    end.set()
    thread.join()
    (found,) = [entry for entry in times.values() if entry.name == "burn (1) x"]
    assert found.used_s >= BURNT_S - 0.02  # a tick of the kernel's clock is 0.01 s
    assert thread.native_id not in thread_times(os.getpid())
    assert process_time_s(os.getpid()) - before_s >= BURNT_S - 0.02  # also of a thread that has ended


def test_adds_up_the_threads_of_a_name() -> None:
    before = {1: ThreadTime("pool", 1.0), 2: ThreadTime("odometry", 2.0)}
    after = {1: ThreadTime("pool", 1.5), 2: ThreadTime("odometry", 6.0), 3: ThreadTime("pool", 0.5)}
    assert shares(before, after, 10.0) == {"odometry": (1, 0.4), "pool": (2, 0.1)}
