"""The daemon as a systemd service: says when it is ready and how it is, and that it is alive as long as it is.

Alive means that no stage has been at one message, with or without others waiting, for longer than it may. A daemon
whose cameras are gone has nothing to do, which is not that.
"""

from __future__ import annotations

import faulthandler
import logging
import os
import signal
import socket
import time
from collections.abc import Callable, Collection
from contextlib import suppress
from typing import Final

from omnid.diagnostics.run_statistics import RunStatistics
from omnid.engine.logging_setup import log
from omnid.engine.telemetry import StageStats, Telemetry

STATUS_PERIOD_S: Final = 1.0
_FEEDS_A_PERIOD: Final = 3
_LONGEST_STATUS: Final = 500  # characters


def notify(state: str) -> bool:
    """Sends the state, such as "READY=1", to systemd (sd_notify(3)); False where there is none that listens now.

    Never waits.
    """
    address = os.environ.get("NOTIFY_SOCKET", "")
    if address[:1] not in ("/", "@"):
        return False
    with suppress(OSError, ValueError), socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM | socket.SOCK_CLOEXEC) as line:
        place = address.replace("@", "\0", 1) if address[0] == "@" else address
        line.sendto(state.encode("utf-8", "replace"), socket.MSG_DONTWAIT | socket.MSG_NOSIGNAL, place)
        return True
    return False


def watchdog_s() -> float | None:
    """Within which time systemd wants to hear that this process is alive, s; None if it does not ask."""
    asked, whom = os.environ.get("WATCHDOG_USEC", ""), os.environ.get("WATCHDOG_PID", "")
    if whom not in ("", str(os.getpid())) or not (asked.isascii() and asked.isdigit()) or int(asked) == 0:
        return None
    return int(asked) * 1e-6


def show_stacks_at_the_end() -> None:
    """Has a daemon that is killed for being stuck write on stderr, if that is a file, where each of its threads was."""
    with suppress(OSError, ValueError):
        faulthandler.enable()  # SIGABRT, by which systemd's watchdog ends a service
        faulthandler.register(signal.SIGXCPU, chain=True)  # by which the kernel ends what runs on at real-time priority


def hung(stages: Collection[StageStats], now_ns: int, longest_s: float) -> dict[str, float]:
    """For how long each stage has been at one message that has been at it for longer than longest_s, s."""
    busy_s = {stats.name: (now_ns - since_ns) * 1e-9 for stats in stages if (since_ns := stats.busy_since_ns)}
    return {name: duration_s for name, duration_s in busy_s.items() if duration_s > longest_s}


class Service:
    """An action for a ticker of the graph: the first call says READY, each one the status, and that we are alive.

    The watchdog is not fed while a stage is hung; which one it is is said once, and again when it has gone on.
    """

    def __init__(self, telemetry: Telemetry, status: Callable[[], str], hung_s: float) -> None:
        """hung_s: how long a stage may be at one message."""
        self._telemetry, self._status, self._hung_s = telemetry, status, hung_s
        self._hung: frozenset[str] = frozenset()
        self._ready = False

    @property
    def period_s(self) -> float:
        """How often to call."""
        return min(STATUS_PERIOD_S, (watchdog_s() or STATUS_PERIOD_S * _FEEDS_A_PERIOD) / _FEEDS_A_PERIOD)

    def __call__(self) -> None:
        """Tells systemd how we are."""
        stuck = hung(self._telemetry.stages, time.monotonic_ns(), self._hung_s)
        self._tell_of(stuck)
        ready = [] if self._ready else ["READY=1"]
        alive = [] if stuck else ["WATCHDOG=1"]
        self._ready = notify("\n".join([*ready, *alive, f"STATUS={self._line(stuck)}"])) or self._ready

    def close(self) -> None:
        """Says that the end has begun; from now on nobody watches but the clock (TimeoutStopSec)."""
        notify("STOPPING=1\nSTATUS=stopping")

    def _line(self, stuck: dict[str, float]) -> str:
        words = [f"{name} hung for {duration_s:.0f} s" for name, duration_s in stuck.items()]
        return " ".join(", ".join([*words, self._status()]).split())[:_LONGEST_STATUS]

    def _tell_of(self, stuck: dict[str, float]) -> None:
        for name in stuck.keys() - self._hung:
            log(logging.ERROR, f"stage '{name}' is hung: {stuck[name]:.1f} s at one message; systemd's watchdog is fed "
                "no more")
        for name in self._hung - stuck.keys():
            log(logging.INFO, f"stage '{name}' has gone on")
        self._hung = frozenset(stuck)


class StatusLine:
    """One line about the run: state, poses per second since the last look, what was lost."""

    def __init__(self, statistics: RunStatistics, telemetry: Telemetry, tickers: Collection[str] = ()) -> None:
        """tickers: the names whose `dropped` are deadlines, not messages."""
        self._statistics, self._telemetry, self._tickers = statistics, telemetry, frozenset(tickers)
        self._poses, self._looked_ns = statistics.poses, time.monotonic_ns()

    def __call__(self) -> str:
        """The line now."""
        now_ns, poses, newest = time.monotonic_ns(), self._statistics.poses, self._statistics.newest
        rate_hz = (poses - self._poses) / max(1e-3, (now_ns - self._looked_ns) * 1e-9)
        self._poses, self._looked_ns = poses, now_ns
        state = newest.state if newest is not None and rate_hz > 0 else "waiting for images"
        dropped = sum(stats.dropped for stats in self._telemetry.stages if stats.name not in self._tickers)
        late = sum(stats.dropped for stats in self._telemetry.stages if stats.name in self._tickers)
        return f"{state}, {rate_hz:.1f} poses/s, {dropped} messages dropped, {late} deadlines missed"
