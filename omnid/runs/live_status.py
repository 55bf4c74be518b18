"""The tickers of a live run: its status on the bus and in the recording, the watchdog, the line on a terminal."""

from __future__ import annotations

import logging
import time
from collections.abc import Callable
from contextlib import suppress
from functools import partial
from typing import Final, TypeAlias

from omnid.config import Config
from omnid.core.control.arming import MANUAL
from omnid.diagnostics.run_statistics import RunStatistics
from omnid.diagnostics.status import StatusCollector, StatusTick
from omnid.engine.logging_setup import Report
from omnid.errors import OmnidError
from omnid.runs.session import TICKERS, Session
from omnid.runs.systemd import Service, StatusLine
from omnid.sinks.encoder import status_report
from omnid.sinks.recorder import Recorder
from omnid.transport.bus import Bus
from omnid.transport.records import DiagnosticStatus
from omnid.transport.status_names import with_remedy

StatusPublisher: TypeAlias = Callable[[list[DiagnosticStatus]], None]


def add_status_tickers(session: Session, status: StatusCollector, bus: Bus, recorder: Recorder | None) -> None:
    """Publish and record the status periodically, and report progress to the service manager."""
    config, graph = session.config, session.graph
    publishers = [_status_on_bus(bus)]
    if recorder is not None:
        publishers.append(_status_in_recording(recorder, session.now_ns))
    graph.ticker("status", config.live.status_s, StatusTick(status, *publishers))
    line = StatusLine(session.statistics, graph.telemetry, TICKERS)
    service = Service(graph.telemetry, line, config.service.stall_timeout_s)
    graph.ticker("watchdog", service.period_s, service)


def add_terminal_ticker(
    session: Session, show: Callable[[str], None], report: Report, words: Callable[[], str]
) -> None:
    """Show the status in one line of a terminal; show: rewrites that line, which ends with the words."""
    line = StatusLine(session.statistics, session.graph.telemetry, TICKERS)
    terminal = TerminalStatus(
        show, lambda: line() + words(), partial(report, logging.INFO), session.statistics, _ready(session.config)
    )
    session.graph.ticker("terminal", terminal.period_s, terminal)


def _ready(config: Config) -> str:
    """Return what to do now that the run is ready."""
    endpoints = ", ".join(config.bus.connect if config.bus.is_client else config.bus.listen)
    wheels = ""
    if not config.motor.port:
        wheels = "; no motor"
    elif config.controller.arming == MANUAL:
        wheels = "; the wheels turn after `omnid arm`"
    return f"ready: poses of {config.bus.robot!r} at {endpoints or 'no endpoint'} (`omnid listen`){wheels}; Ctrl-C ends"


def _status_on_bus(bus: Bus) -> StatusPublisher:
    """Return a function that publishes statuses; where the bus is slow, only the status ticker waits."""

    def publish(statuses: list[DiagnosticStatus]) -> None:
        with suppress(OmnidError):  # the system's clock may be set to a time that no message can hold
            message = status_report(time.time_ns(), [with_remedy(status) for status in statuses])
            bus.publish(message.topic, message.payload)

    return publish


def _status_in_recording(recorder: Recorder, clock_ns: Callable[[], int]) -> StatusPublisher:
    """Return a function that records statuses, in the time of all other messages also when the clock was set."""

    def record(statuses: list[DiagnosticStatus]) -> None:
        now_ns = clock_ns()
        with suppress(OmnidError):  # the system's clock may be set to a time that no message can hold
            recorder.add(status_report(now_ns, statuses), now_ns)

    return record


class TerminalStatus:
    """The action of a ticker: shows a line as long as the run lasts."""

    period_s: Final = 0.5

    def __init__(
        self,
        show: Callable[[str], None],
        line: Callable[[], str],
        report: Callable[[str], None],
        statistics: RunStatistics,
        ready: str,
    ) -> None:
        """show: rewrites the line. line: its text. report: takes lines that stay. ready: of the start."""
        self._show, self._line, self._report = show, line, report
        self._statistics, self._ready = statistics, ready

    def __call__(self) -> None:
        """Report that the run is ready, once, and show the line."""
        if self._ready:
            self._report(self._ready)
            self._ready = ""
        self._show(f"{self._statistics.length_m:8.2f} m  {self._line()}")

    def close(self) -> None:
        """Remove the line, and report the summary."""
        self._show("")
        statistics = self._statistics
        states = ", ".join(f"{state} {count / statistics.poses:.1%}" for state, count in statistics.states.items())
        self._report(
            f"ended: {statistics.poses} poses, {statistics.length_m:.2f} m, {statistics.resets} resets"
            f"{f'; {states}' if states else ''}"
        )
