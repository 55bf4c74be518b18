"""A poller calls its action again and again, an action that fails included, until it is closed."""

from __future__ import annotations

import threading

import pytest

from omnid.engine.poller import Poller

LONG_S = 20.0  # a timeout that only a defect reaches

pytestmark = pytest.mark.usefixtures("no_thread_is_left")


def test_the_calls_go_on_after_an_error_and_end_with_close(capsys: pytest.CaptureFixture[str]) -> None:
    calls, enough = list[str](), threading.Event()

    def action() -> None:
        calls.append(threading.current_thread().name)
        if len(calls) == 1:
            raise OSError("no link")
        if len(calls) == 3:
            enough.set()

    poller = Poller(action, 1e-3, "short work")
    assert enough.wait(LONG_S)
    poller.close()
    count = len(calls)
    assert set(calls) == {"short work"} and capsys.readouterr().err.count("OSError: no link") == 1
    assert not threading.Event().wait(0.02) and len(calls) == count


def test_an_action_may_close_its_own_poller() -> None:
    made, closed = threading.Event(), threading.Event()
    pollers = list[Poller]()

    def action() -> None:
        made.wait(LONG_S)
        pollers[0].close()
        closed.set()

    pollers.append(Poller(action, 1e-3, "short work"))
    made.set()
    assert closed.wait(LONG_S)
    pollers[0].close()
