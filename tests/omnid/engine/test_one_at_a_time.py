"""A lock that one thread at a time enters."""

from __future__ import annotations

import threading

import pytest

from omnid.engine.one_at_a_time import OneAtATime


def test_a_second_thread_waits_until_the_first_has_left() -> None:
    lock, entered, at_the_door = OneAtATime(), threading.Event(), threading.Event()

    def enter() -> None:
        at_the_door.set()
        with lock:
            entered.set()

    thread = threading.Thread(target=enter)
    with lock:
        thread.start()
        assert at_the_door.wait(20.0) and not entered.wait(0.05)
    assert entered.wait(20.0)
    thread.join()


def test_an_error_leaves_the_lock() -> None:
    lock = OneAtATime()
    with pytest.raises(ValueError), lock:
        raise ValueError
    with lock:
        pass
