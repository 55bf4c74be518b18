"""Threads without a graph: calls that may block, and short work again and again."""

from __future__ import annotations

import subprocess
import sys
import threading

import pytest

from omnid.engine.threads import Poller, returns_within, started

LONG_S = 20.0  # a timeout that only a defect reaches


def test_a_caller_goes_on_after_its_time_and_may_wait_later() -> None:
    called, release, done = threading.Event(), threading.Event(), list[bool]()
    assert returns_within(called.set, LONG_S, "quick") and called.is_set()
    assert not returns_within(lambda: bool(release.wait(LONG_S)) and None, 0.01, "slow")
    wait = started(lambda: done.append(release.wait(LONG_S)), "test")
    assert not done
    release.set()
    wait()
    assert done == [True]


def test_a_call_that_blocks_for_ever_does_not_keep_the_program_from_ending() -> None:
    code = (
        "import threading; from omnid.engine.threads import returns_within; "
        "print(returns_within(threading.Event().wait, 0.01, 'blocked'))"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=60, check=True)
    assert done.stdout == "False\n"


@pytest.mark.usefixtures("no_thread_is_left")
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
    assert not threading.Event().wait(0.02) and len(calls) == 3
