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
    RealtimeSettings,
    ThreadStart,
    highest_priority,
    may_lock,
    priorities,
)

ROOT = Path(__file__).parents[3]
UNPRIVILEGED = 65534
allowed = pytest.mark.skipif(highest_priority() < 20, reason="no right to real-time priorities: ulimit -r 20")
PREAMBLE = """
from omnid.engine.process import use_one_malloc_arena
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


def test_threads_have_names_in_the_kernel() -> None:
    assert seen_in("lower", ThreadStart({})) == {"source": ("lower", os.SCHED_OTHER), "sink": ("sink", os.SCHED_OTHER)}


@allowed
def test_only_the_named_thread_has_priority() -> None:
    seen = seen_in("lower", ThreadStart({"lower": 10}))
    assert seen == {"source": ("lower", os.SCHED_FIFO | os.SCHED_RESET_ON_FORK), "sink": ("sink", os.SCHED_OTHER)}


@allowed
def test_priorities_come_from_the_configuration_and_are_not_inherited() -> None:
    assert priorities(RealtimeSettings(capture_priority=7), "lower", "upper") == {"lower": 7, "upper": 7}
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


@pytest.mark.skipif(not may_lock(), reason="no right to lock memory: ulimit -l unlimited")
def test_locks_memory_without_allocating_it() -> None:
    done = answer("""
import cv2
before = locked_kb()
reported = lock_memory()
room = bytearray(8 << 20)
lines = Path("/proc/self/status").read_text().splitlines()
resident = next(int(line.split()[1]) for line in lines if line.startswith("VmRSS"))
print(json.dumps({"reported": reported, "before": before, "locked": locked_kb(), "resident": resident}))
""")
    assert done.reported == "" and done.before == 0
    assert done.locked > 100_000 and done.resident < done.locked / 2  # stacks of OpenCV's threads, never touched


def test_prepare_applies_the_settings() -> None:
    done = answer("""
refused = prepare(RealtimeSettings(lock_memory=False, longest_run_ms=300))
print(json.dumps({"frozen": gc.get_freeze_count(), "switch_s": sys.getswitchinterval(), "refused": refused,
                  "run": resource.getrlimit(resource.RLIMIT_RTTIME)[0]}))
""")
    assert done.frozen > 1000 and done.refused == []
    assert (done.switch_s, done.run) == (pytest.approx(1e-3), 300_000)


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


ALLOCATING_THREAD = """
def resident_mb():
    lines = Path("/proc/self/status").read_text().splitlines()
    return next(int(line.split()[1]) for line in lines if line.startswith("VmRSS")) / 1024
def work():
    for _ in range(3):
        data = [b"x" * 60_000 for _ in range(700)]
lock_memory()
before = resident_mb()
thread = threading.Thread(target=work); thread.start(); thread.join()
print(json.dumps({"kept_mb": resident_mb() - before}))
"""


@pytest.mark.skipif(not may_lock(), reason="no right to lock memory: ulimit -l unlimited")
def test_freed_memory_of_a_thread_returns_to_the_kernel_though_locked() -> None:
    """The thread frees 42 MB, which a malloc arena of its own would keep."""
    assert answer("use_one_malloc_arena()" + ALLOCATING_THREAD).kept_mb < 10


GIVEN_BACK = """
import llvmlite.binding as llvm
from omnid.engine.realtime import give_back_code
def code_kb():
    kb, is_code = 0, False
    for line in Path("/proc/self/smaps").read_text().splitlines():
        words = line.split()
        if "-" in words[0]:
            is_code = words[1] == "r-xp" and "llvmlite" in line
        kb += int(words[1]) if is_code and words[0] == "Rss:" else 0
    return kb
llvm.initialize_native_target()
before_kb = code_kb()
give_back_code("llvmlite")
after_kb = code_kb()
llvm.parse_assembly("define void @f() { ret void }").verify()
print(json.dumps({"before_kb": before_kb, "after_kb": after_kb, "again_kb": code_kb()}))
"""


def test_code_that_was_given_back_is_read_again_where_it_is_run() -> None:
    found = answer(GIVEN_BACK)
    assert found.before_kb > 1000 and found.after_kb == 0 < found.again_kb
