"""Calls that may block: their caller goes on after its time, and the program ends."""

from __future__ import annotations

import subprocess
import sys
import threading

from omnid.engine.bounded_call import returns_within, started


def test_says_whether_the_call_has_returned() -> None:
    called, release = threading.Event(), threading.Event()
    assert returns_within(called.set, 20.0, "quick") and called.is_set()
    assert not returns_within(lambda: bool(release.wait(20.0)) and None, 0.01, "slow")
    release.set()


def test_a_call_that_blocks_for_ever_does_not_keep_the_program_from_ending() -> None:
    code = (
        "import threading; from omnid.engine.bounded_call import returns_within; "
        "print(returns_within(threading.Event().wait, 0.01, 'blocked'))"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=60, check=True)
    assert done.stdout == "False\n"


def test_the_caller_goes_on_and_waits_later() -> None:
    allowed, done = threading.Event(), []

    def action() -> None:
        allowed.wait(10)
        done.append(threading.current_thread().daemon)

    wait = started(action, "test")
    assert not done
    allowed.set()
    wait()
    assert done == [True]
