"""A connection to a robot that may not be there yet: tried again, each reason said once."""

from __future__ import annotations

import time

import pytest

from omnid.monitor.connecting import connected_until
from omnid.transport.session import Unreachable


def test_it_is_tried_until_there_is_one(capsys: pytest.CaptureFixture[str]) -> None:
    reasons = ["refused", "refused", "no route"]

    def connect() -> str:
        if reasons:
            raise Unreachable(reasons.pop(0))
        return "robot"

    assert connected_until(time.monotonic() + 60.0, connect) == "robot"
    assert capsys.readouterr().err == "omnid: waiting: refused\nomnid: waiting: no route\n"


def test_the_end_and_a_signal_end_it() -> None:
    def connect() -> str:
        raise Unreachable("refused")

    assert connected_until(time.monotonic() - 1.0, connect) is None
    assert connected_until(time.monotonic() + 60.0, connect, [2]) is None
