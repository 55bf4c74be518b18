"""The daemon as a systemd service: readiness, status line and watchdog (sd_notify(3)).

The watchdog is fed as long as no stage works on one message for longer than service.stall_timeout_s. A daemon that
waits for images has no message in work, so it stays alive.
"""

from __future__ import annotations

import faulthandler
import logging
import math
import os
import socket
import time
from collections.abc import Callable
from contextlib import suppress
from typing import Any

from omnid.core.nanoseconds import S_PER_NS
from omnid.diagnostics.run_summary import RunStatistics
from omnid.engine.logging_setup import log
from omnid.engine.telemetry import Telemetry
from omnid.transport.status_names import Key


def notify(state: str) -> bool:
    """Send the state, such as "READY=1", to systemd without waiting; return False if nothing received it."""
    address = os.environ.get("NOTIFY_SOCKET", "")
    if address[:1] not in ("/", "@"):
        return False
    kind = socket.SOCK_DGRAM | socket.SOCK_CLOEXEC
    with suppress(OSError, ValueError), socket.socket(socket.AF_UNIX, kind) as sender:
        destination = address.replace("@", "\0", 1) if address[0] == "@" else address
        sender.sendto(state.encode("utf-8", "replace"), socket.MSG_DONTWAIT | socket.MSG_NOSIGNAL, destination)
        return True
    return False


def watchdog_s() -> float | None:
    """Return the timeout of systemd's watchdog [s]; None if it does not watch this process."""
    timeout_us, pid = os.environ.get("WATCHDOG_USEC", ""), os.environ.get("WATCHDOG_PID", "")
    is_number = timeout_us.isascii() and timeout_us.isdigit()
    if pid not in ("", str(os.getpid())) or not is_number or int(timeout_us) == 0:
        return None
    return int(timeout_us) * 1e-6


def print_stacks_when_killed() -> None:
    """Print the stacks of all threads on stderr, if that is a file, when the process is killed for a stalled thread."""
    with suppress(OSError, ValueError):
        faulthandler.enable()  # SIGABRT, sent by systemd's watchdog


class Service:
    """The action of a ticker: notifies systemd that the daemon is ready, and of its status, and feeds the watchdog.

    The watchdog is not fed while a stage is stalled; that is logged once.
    """

    def __init__(self, telemetry: Telemetry, status: Callable[[], str], stall_timeout_s: float) -> None:
        """stall_timeout_s: longest time that a stage may work on one message."""
        self._telemetry, self._status, self._stall_timeout_s = telemetry, status, stall_timeout_s
        self._stalled: frozenset[str] = frozenset()
        self._ready = False

    @property
    def period_s(self) -> float:
        """Time between two calls: a second at most, and a third of the watchdog's timeout, so that one may be late."""
        return min(1.0, (watchdog_s() or math.inf) / 3)

    def __call__(self) -> None:
        """Notify systemd."""
        # 1. Stages that work on one message for too long, with that time [s].
        now_ns = time.monotonic_ns()
        busy = [(stage.name, stage.busy_since_ns) for stage in self._telemetry.stages]
        busy_s = {name: (now_ns - since_ns) * S_PER_NS for name, since_ns in busy if since_ns}
        stalled = {name: duration_s for name, duration_s in busy_s.items() if duration_s > self._stall_timeout_s}
        for name in stalled.keys() - self._stalled:
            log(
                logging.ERROR,
                f"stage '{name}' is stalled: {stalled[name]:.1f} s at one message; systemd's watchdog is no longer fed",
            )
        self._stalled = frozenset(stalled)
        # 2. What is reported.
        words = ", ".join([*(f"{name} stalled for {stalled[name]:.0f} s" for name in stalled), self._status()])
        ready = [] if self._ready else ["READY=1"]
        alive = [] if stalled else ["WATCHDOG=1"]
        self._ready = notify("\n".join([*ready, *alive, f"STATUS={' '.join(words.split())}"])) or self._ready

    def close(self) -> None:
        """Notify systemd that the daemon stops; from now on only TimeoutStopSec limits it."""
        notify("STOPPING=1\nSTATUS=stopping")


class StatusLine:
    """One line about the run: state, poses per second since the last call, dropped messages, missed deadlines."""

    def __init__(
        self, statistics: RunStatistics, telemetry: Telemetry, stats: Callable[[], dict[str, Any]] = dict
    ) -> None:
        """stats: numbers of a simulated robot."""
        self.statistics, self._telemetry, self._stats = statistics, telemetry, stats
        self._poses, self._called_ns = statistics.poses, time.monotonic_ns()

    def __call__(self) -> str:
        """Return the line."""
        now_ns, poses, newest = time.monotonic_ns(), self.statistics.poses, self.statistics.newest
        rate_hz = (poses - self._poses) / max(1e-3, (now_ns - self._called_ns) * S_PER_NS)
        self._poses, self._called_ns = poses, now_ns
        state = newest.state if newest is not None and rate_hz > 0 else "waiting for images"
        dropped, late = self._telemetry.dropped_messages, self._telemetry.missed_deadlines
        factor = self._stats().get(Key.REAL_TIME_FACTOR)
        pace = "" if factor is None else f", {factor:.2f} x real time"
        return f"{state}, {rate_hz:.1f} poses/s, {dropped} messages dropped, {late} deadlines missed{pace}"

    def summary(self) -> str:
        """Return one line about the whole run."""
        found = self.statistics
        states = ", ".join(f"{state} {count / found.poses:.1%}" for state, count in found.states.items())
        length = f"{found.poses} poses, {found.length_m:.2f} m, {found.resets} resets"
        return f"ended: {'; '.join([length, states] if states else [length])}"
