"""The daemon as a systemd service: readiness, status line and watchdog (sd_notify(3)); the line of a terminal."""

from __future__ import annotations

import logging
import os
import socket
import time
from collections.abc import Callable
from contextlib import suppress

from omnid.core.nanoseconds import S_PER_NS
from omnid.diagnostics.run_summary import RunStatistics
from omnid.engine.logging_setup import log
from omnid.engine.telemetry import Telemetry
from omnid.plain_text import one_line


def notify(*lines: str) -> None:
    """Send lines such as "READY=1" to systemd without waiting, if it started this process."""
    address = os.environ.get("NOTIFY_SOCKET", "")
    destination = f"\0{address[1:]}" if address.startswith("@") else address
    kind = socket.SOCK_DGRAM | socket.SOCK_CLOEXEC
    with suppress(OSError, ValueError), socket.socket(socket.AF_UNIX, kind) as sender:
        sender.sendto("\n".join(lines).encode(), socket.MSG_DONTWAIT, destination)


def period_s() -> float:
    """Return the time between two calls of a Service: a third of the watchdog's timeout, so that one may be late."""
    return min(1.0, float(os.environ.get("WATCHDOG_USEC", 3e6)) * 1e-6 / 3)


class Service:
    """Notifies systemd, each time that it is called, that the daemon is ready, of its status, and feeds the watchdog.

    The watchdog is fed as long as no stage works on one message for longer than a time; the first such stage is logged.
    A daemon that waits for images has no message in work.
    """

    def __init__(
        self, telemetry: Telemetry, statistics: RunStatistics, stall_timeout_s: float, show: Callable[[str], object]
    ) -> None:
        """stall_timeout_s: longest time that a stage may work on one message. show: takes the status line."""
        self._telemetry, self._statistics, self._stall_timeout_s = telemetry, statistics, stall_timeout_s
        self._show = show
        self._was_stalled = False
        self._poses, self._called_ns = 0, time.monotonic_ns()

    def __call__(self) -> None:
        """Notify systemd."""
        # 1. Stages that work on one message for too long.
        now_ns, found = time.monotonic_ns(), self._statistics
        busy = [(stage.name, stage.busy_since_ns) for stage in self._telemetry.stages]
        limit_ns = self._stall_timeout_s / S_PER_NS
        stalled = [name for name, since_ns in busy if since_ns and now_ns - since_ns > limit_ns]
        if stalled and not self._was_stalled:
            log(logging.ERROR, f"stalled: {', '.join(stalled)}; the watchdog of systemd is no longer fed")
        self._was_stalled = bool(stalled)
        # 2. State, poses per second since the last call, what was lost.
        rate_hz = (found.poses - self._poses) / max(1e-3, (now_ns - self._called_ns) * S_PER_NS)
        self._poses, self._called_ns = found.poses, now_ns
        state = found.newest.state if found.newest is not None and rate_hz > 0 else "waiting for images"
        dropped, late = self._telemetry.lost(by_tickers=False), self._telemetry.lost(by_tickers=True)
        line = f"{found.length_m:.2f} m, {state}, {rate_hz:.1f} poses/s, {dropped} messages dropped, {late} ticks late"
        line = f"stalled: {', '.join(stalled)}" if stalled else line
        self._show(line)
        notify("READY=1", *([] if stalled else ["WATCHDOG=1"]), f"STATUS={one_line(line)}")
