"""Signals that stop a run reach their handler within the context only, and those that are ignored stay ignored."""

from __future__ import annotations

import signal

import pytest

from omnid.engine.signals import STOP_SIGNALS, handle_stop_signals

pytestmark = pytest.mark.usefixtures("default_signals")


def test_each_signal_reaches_the_handler_and_the_one_before_comes_back() -> None:
    before, came = {number: signal.getsignal(number) for number in STOP_SIGNALS}, list[int]()
    with handle_stop_signals(lambda number, _: came.append(number)):
        for number in STOP_SIGNALS:
            signal.raise_signal(number)
    assert came == [signal.SIGINT, signal.SIGTERM, signal.SIGHUP]
    assert {number: signal.getsignal(number) for number in STOP_SIGNALS} == before


def test_an_ignored_signal_stays_ignored() -> None:
    """As SIGHUP under nohup."""
    signal.signal(signal.SIGHUP, signal.SIG_IGN)
    came = list[int]()
    with handle_stop_signals(lambda number, _: came.append(number)):
        signal.raise_signal(signal.SIGHUP)
        assert signal.getsignal(signal.SIGHUP) is signal.SIG_IGN
    assert came == []


def test_the_handlers_before_come_back_after_an_error() -> None:
    before = signal.getsignal(signal.SIGTERM)
    with pytest.raises(ValueError), handle_stop_signals(lambda number, _: None):
        raise ValueError
    assert signal.getsignal(signal.SIGTERM) is before
