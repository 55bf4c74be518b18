"""Real-time settings take effect where the system allows them, and are reported, not raised, where it does not.

Settings of the whole process are tested in a process of their own.
"""

from __future__ import annotations

import json
import logging
import os
import signal
import subprocess
import sys
import threading
from pathlib import Path
from types import SimpleNamespace

import pytest

from omnid.engine.graph import Graph
from omnid.engine.realtime import (
    LOCK_ADVICE,
    ThreadStart,
    highest_priority,
)

ROOT = Path(__file__).parents[3]
UNPRIVILEGED = 65534
allowed = pytest.mark.skipif(highest_priority() < 20, reason="no right to real-time priorities: ulimit -r 20")
PREAMBLE = """
import gc, json, os, resource, sys, threading, time
from pathlib import Path
from omnid.engine.realtime import RealtimeSettings, ThreadStart, limit_realtime_runs, lock_memory, prepare
from omnid.engine.realtime import set_realtime_priority
def locked_kb():
    lines = Path("/proc/self/status").read_text().splitlines()
    return next(int(line.split()[1]) for line in lines if line.startswith("VmLck"))
"""
WITHOUT_RIGHTS = f"""
resource.setrlimit(resource.RLIMIT_RTPRIO, (0, 0))
resource.setrlimit(resource.RLIMIT_MEMLOCK, (1 << 20, 1 << 20))
if os.getuid() == 0:
    os.setgid({UNPRIVILEGED}); os.setuid({UNPRIVILEGED})
"""


def process(script: str) -> subprocess.CompletedProcess[str]:
    """Run the script in a process of its own."""
    return subprocess.run(
        [sys.executable, "-c", PREAMBLE + script], cwd=ROOT, capture_output=True, text=True, timeout=60
    )


def answer(script: str) -> SimpleNamespace:
    """Return the JSON that the script prints."""
    done = process(script)
    assert done.returncode == 0, done.stderr
    return SimpleNamespace(**json.loads(done.stdout))


def seen_in(name: str, start: ThreadStart) -> dict[str, tuple[str, int]]:
    """Return kernel name and policy of the threads of a graph: a source of this name and its sink."""
    seen = {}

    def record(whose: str) -> None:
        task = Path(f"/proc/self/task/{threading.get_native_id()}")
        seen[whose] = (task.joinpath("comm").read_text().strip(), os.sched_getscheduler(0))

    def numbers() -> range:
        record("source")
        return range(1)

    graph = Graph(on_thread=start)
    graph.sink("sink", SimpleNamespace(process=lambda number: record("sink")), graph.source(name, numbers))
    graph.run()
    return seen


@allowed
def test_only_the_named_thread_has_priority() -> None:
    seen = seen_in("lower", ThreadStart({"lower": 10}))
    assert seen == {"source": ("lower", os.SCHED_FIFO | os.SCHED_RESET_ON_FORK), "sink": ("sink", os.SCHED_OTHER)}


@allowed
def test_priorities_are_not_inherited() -> None:
    script = """
def motor():
    ThreadStart({"motor": 18})("motor")
    found["own"] = os.sched_getparam(0).sched_priority
    child = threading.Thread(target=lambda: found.update(child=os.sched_getscheduler(0)))
    child.start(); child.join()
found = {"main": os.sched_getscheduler(0)}
thread = threading.Thread(target=motor); thread.start(); thread.join()
print(json.dumps(found))
"""
    assert vars(answer(script)) == {"main": os.SCHED_OTHER, "own": 18, "child": os.SCHED_OTHER}


def test_reports_a_refused_priority_once_with_advice() -> None:
    done = answer(
        WITHOUT_RIGHTS
        + """
reported = []
start = ThreadStart({"motor": 20, "lower": 10}, lambda *words: reported.append(words))
for name in ("motor", "lower", "stereo"):
    start(name)
print(json.dumps({"reported": reported, "policy": os.sched_getscheduler(0)}))
"""
    )
    ((priority, text),) = done.reported
    assert priority == logging.WARNING and text.startswith("thread 'motor' cannot have real-time priority 20")
    assert "LimitRTPRIO=20" in text and done.policy == os.SCHED_OTHER


def test_does_not_lock_memory_under_a_limit() -> None:
    done = answer(
        WITHOUT_RIGHTS
        + """
reported = lock_memory()
grown = len(bytearray(50 << 20))
print(json.dumps({"reported": reported, "locked": locked_kb()}))
"""
    )
    assert done.reported.endswith(f"swapped out: {LOCK_ADVICE}") and done.locked == 0  # not even tried


@allowed
def test_the_kernel_ends_a_real_time_thread_that_does_not_wait() -> None:
    done = process("""
limit_realtime_runs(50)
assert set_realtime_priority(10)
until_s = time.monotonic() + 20
while time.monotonic() < until_s:
    pass
""")
    assert done.returncode == -signal.SIGXCPU
