"""A daemon as systemd sees it: notifications, watchdog, and the difference between a stalled and an idle stage."""

from __future__ import annotations

import logging
import socket
import time
from collections.abc import Callable
from pathlib import Path

import pytest

from omnid.diagnostics.status import RunStatistics
from omnid.engine.graph import StageStats
from omnid.runs.live import Service, period_s


@pytest.fixture
def received(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Callable[[], list[str]]:
    """Return the lines of the next message that systemd gets."""
    monkeypatch.setenv("NOTIFY_SOCKET", str(tmp_path / "notify"))
    manager = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
    manager.bind(str(tmp_path / "notify"))
    manager.settimeout(5.0)
    return lambda: manager.recv(4096).decode().split("\n")


@pytest.mark.parametrize(("timeout_us", "expected_s"), [(None, 1.0), ("10000000", 1.0), ("1500000", 0.5)])
def test_three_notifications_fit_into_the_timeout_of_the_watchdog(
    timeout_us: str | None, expected_s: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.delenv("WATCHDOG_USEC", raising=False)
    if timeout_us:
        monkeypatch.setenv("WATCHDOG_USEC", timeout_us)
    assert period_s() == pytest.approx(expected_s)


def test_a_stalled_stage_stops_the_watchdog_and_is_logged_once(
    received: Callable[[], list[str]], caplog: pytest.LogCaptureFixture
) -> None:
    caplog.set_level(logging.INFO, "omnid")
    stage = StageStats()
    service = Service({"valve": stage, "idle": StageStats()}, RunStatistics(), 0.5)
    stage.busy_since_ns = time.monotonic_ns()  # It has just begun.
    service()
    line = "0.00 m, waiting for images, 0 messages dropped"
    assert received() == ["READY=1", "WATCHDOG=1", f"STATUS={line}"]
    stage.busy_since_ns -= 10**9
    for _ in range(2):
        service()
        assert received() == ["READY=1", "STATUS=stalled: valve"]
    assert caplog.text.count("stalled: valve") == 1
    stage.busy_since_ns = 0
    service()
    assert "WATCHDOG=1" in received()
