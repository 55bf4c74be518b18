"""Parts of the engine without a graph: threads, signals, counters, logging, clocks, real-time settings, kernels."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
import threading
from pathlib import Path

import pytest

from omnid.engine.graph import Poller
from omnid.engine.process import python, python_environment
from omnid.engine.robot_clock import RobotClock
from tests.set_clock import SetClock

ROOT = Path(__file__).parents[3]
LONG_S = 20.0  # a timeout that only a defect reaches


def test_the_calls_of_a_poller_go_on_after_an_error_and_end_with_close(capsys: pytest.CaptureFixture[str]) -> None:
    calls, made, enough = list[str](), threading.Event(), threading.Event()

    def action() -> None:
        assert made.wait(LONG_S)  # the first calls may come before the poller has its name here
        calls.append(threading.current_thread().name)
        if len(calls) == 1:
            raise OSError("no link")
        if len(calls) == 3:
            enough.set()
            poller.close()  # an action may close its own poller

    poller = Poller(action, 1e-3, "short work")
    made.set()
    assert enough.wait(LONG_S)
    poller.close()
    assert set(calls) == {"short work"} and capsys.readouterr().err.count("OSError: no link") == 1
    assert not threading.Event().wait(0.02) and len(calls) == 3 and "short work" not in map(str, threading.enumerate())


def test_modules_of_the_current_folder_are_not_imported(tmp_path: Path) -> None:
    (tmp_path / "omnid.py").write_text("print('planted')")
    words = python("-c", "import omnid, os; print(omnid.__file__, os.environ['KEY'])")
    environment = python_environment(KEY="a")
    done = subprocess.run(words, cwd=tmp_path, env=environment, capture_output=True, text=True, check=True)
    assert done.stdout == f"{ROOT / 'omnid' / '__init__.py'} a\n"


SETUP = "import logging; from omnid.engine.logging_setup import *; configure_logging(); configure_logging()\n"
LOG = SETUP + (
    "log(logging.WARNING, 'one'); log(logging.INFO, 'two'); library = logging.getLogger('library')\n"
    "library.info('detail'); library.warning('careful, %d', 7); library.critical('broken')"
)


def test_log_lines_have_priorities_for_journald(tmp_path: Path) -> None:
    with (tmp_path / "journal").open("w") as file:
        found = os.fstat(file.fileno())
        environment = os.environ | {"JOURNAL_STREAM": f"{found.st_dev}:{found.st_ino}"}
        subprocess.run([sys.executable, "-c", LOG], cwd=ROOT, env=environment, stderr=file, check=True)
    assert (tmp_path / "journal").read_text() == "<4>one\n<6>two\n<4>library: careful, 7\n<2>library: broken\n"


def test_a_refused_priority_is_reported_with_advice() -> None:
    """In a process of its own, without rights."""
    script = """
import json, os, resource
from omnid.engine.process import start_thread
resource.setrlimit(resource.RLIMIT_RTPRIO, (0, 0))
if os.getuid() == 0:
    os.setgid(65534); os.setuid(65534)
print(json.dumps([start_thread("motor", 20), start_thread("stereo"), os.sched_getscheduler(0)]))
"""
    done = subprocess.run([sys.executable, "-c", script], cwd=ROOT, capture_output=True, text=True, timeout=60)
    text, of_ordinary, policy = json.loads(done.stdout)
    assert text.startswith("thread 'motor' cannot have real-time priority 20") and "LimitRTPRIO" in text
    assert of_ordinary == "" and policy == os.SCHED_OTHER


S = 10**9
START_NS = 1_700_000_000 * S


@pytest.mark.parametrize(
    ("step_s", "words"),
    [(3600.0, "forwards by 3600.000 s"), (0.02, "forwards by 0.020 s"), (-3 * 3600.0, "back by 10800.000 s")],
)
def test_a_step_is_found_and_logged_once_and_stamps_from_before_it_keep_their_time(
    step_s: float, words: str, caplog: pytest.LogCaptureFixture
) -> None:
    computer = SetClock(START_NS)
    clock = computer.clock()
    computer.advance(100.0)
    before_ns = computer.monotonic_ns
    assert clock.unix_ns(before_ns) == START_NS + before_ns
    sent_before_ns = computer.unix_ns
    computer.set_forwards(step_s)
    computer.advance(0.1)
    now_ns, change_ns = computer.monotonic_ns, round(step_s * 1e9)
    assert [clock.unix_ns(now_ns) for _ in range(3)] == [START_NS + now_ns + change_ns] * 3
    assert clock.unix_ns(before_ns) == START_NS + before_ns, "the messages of one pair have one time"
    # A message that was on its way during the step is as old as it is, and so is one that is sent after it.
    assert clock.age_ns(sent_before_ns) == pytest.approx(0.1e9) and clock.age_ns(computer.unix_ns) == 0
    # A sender whose clock is another one is off by the step; sent once more it is still older.
    other_ns = computer.unix_ns - change_ns
    assert clock.age_ns(other_ns) == change_ns
    assert len(caplog.messages) == 1 and words in caplog.text and clock.steps == 1


@pytest.mark.parametrize("rate", [-500e-6, 40e-6])
def test_slewing_is_followed_in_silence(rate: float, caplog: pytest.LogCaptureFixture) -> None:
    computer = SetClock(START_NS)
    clock, unix_ns = computer.clock(), 0
    for _ in range(4000):
        computer.advance(0.1)
        computer.set_forwards(0.1 * rate)
        before_ns, unix_ns = unix_ns, clock.unix_ns(computer.monotonic_ns)
        assert abs(unix_ns - computer.unix_ns) < 1_100_000 and unix_ns > before_ns
    assert not caplog.messages and clock.steps == 0


def test_a_thread_that_is_not_scheduled_between_two_readings_has_seen_no_step(caplog: pytest.LogCaptureFixture) -> None:
    computer, pauses_s = SetClock(START_NS), [0.0]

    def late_ns() -> int:
        computer.advance(pauses_s[0])
        return computer.monotonic_ns

    clock = RobotClock(late_ns, lambda: computer.unix_ns)
    pauses_s[0] = 0.05
    for _ in range(50):
        clock.follow()
    assert not caplog.messages and clock.unix_ns(5 * S) == START_NS + 5 * S


CALLEE = """
from omnid.core.compiled import inner

@inner
def part(value):
    return value / 2
"""
CALLER = """
from omnid.core.callee_kernels import part
from omnid.core.compiled import compiled

@compiled("(f8[::1], f8[::1])", writes=("out",))
def parts(values, out):
    for n in range(len(values)):
        out[n] = part(values[n])
"""
PROGRAM = """
import logging, sys
from omnid.engine.kernel_cache import prepare_kernels
logging.basicConfig(stream=sys.stdout, level=logging.INFO, format="%(levelname)s %(message)s")
prepare_kernels()
import numpy as np
from omnid.core.caller_kernels import parts
out = np.zeros(2)
parts(np.array([3.0, 6.0]), out)
print(out.tolist())
"""
OTHER = """
from omnid.core.compiled import compiled

@compiled("(f8[::1],)", writes=("out",))
def zero(out):
    out[:] = 0
"""
HALVES = "[1.5, 3.0]"


@pytest.fixture
def copy(tmp_path: Path) -> Path:
    """A folder with the copy of omnid."""
    for package in ("omnid", "drivers", "calib"):
        shutil.copytree(
            ROOT / package, tmp_path / package, ignore=shutil.ignore_patterns("__pycache__", "*.mcap", "*_kernels.py")
        )
    (tmp_path / "omnid/core/callee_kernels.py").write_text(CALLEE)
    (tmp_path / "omnid/core/caller_kernels.py").write_text(CALLER)
    (tmp_path / "omnid/core/other_kernels.py").write_text(OTHER)
    return tmp_path


def process_of(copy: Path, cache: Path) -> subprocess.Popen[str]:
    environment = os.environ | {"OMNID_CACHE_DIR": str(cache), "PYTHONPATH": str(copy)}
    command, pipe = [sys.executable, "-P", "-c", PROGRAM], subprocess.PIPE
    return subprocess.Popen(command, stdout=pipe, stderr=pipe, text=True, env=environment, cwd=copy)


def run(copy: Path, cache: Path) -> list[str]:
    """Return what a program prints."""
    with process_of(copy, cache) as program:
        output, errors = program.communicate(timeout=300)
    return (output + errors).splitlines()


def test_the_first_program_compiles_and_others_read_until_a_file_is_edited(copy: Path) -> None:
    """An edit of the callee counts, too, which numba itself would not notice; the code of other files stays."""
    cache = copy / "cache"
    with process_of(copy, cache) as one, process_of(copy, cache) as other:
        outputs = [program.communicate(timeout=300)[0].splitlines() for program in (one, other)]
    assert [output[-1] for output in outputs] == [HALVES, HALVES]
    assert any(output[0].startswith("INFO compiling the loops") for output in outputs)
    assert run(copy, cache) == [HALVES]
    kept = {path.name for path in cache.iterdir()}
    assert {name.partition("-")[0] for name in kept} == {"callee_kernels", "caller_kernels", "other_kernels"}
    (copy / "omnid/core/callee_kernels.py").write_text(CALLEE.replace("/ 2", "/ 3"))
    first, *_, last = run(copy, cache)
    assert first.startswith("INFO compiling") and last == "[1.0, 2.0]"
    now = {path.name for path in cache.iterdir()}
    assert len(now) == 3 and {name.partition("-")[0] for name in now & kept} == {"other_kernels"}


def test_code_that_others_could_have_written_is_not_read(copy: Path) -> None:
    cache = copy / "cache"
    run(copy, cache)
    for kept in cache.glob("caller_kernels-*"):
        kept.chmod(0o720)
    assert run(copy, cache)[0].startswith("INFO compiling") and run(copy, cache) == [HALVES]
    cache.chmod(0o702)
    assert "it belongs to another user, or others can write to it" in run(copy, cache)[-1]
