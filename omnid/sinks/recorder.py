"""A log of what the daemon made of its input, for ROS 2, Foxglove, Rerun and evo."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from typing import TypeAlias

from drivers.logs.mcap_writer import LogWriter
from omnid.diagnostics.run_statistics import RunStatistics
from omnid.messages import OdometryUpdate
from omnid.sinks.encoder import Encoder, Outgoing, OutgoingMessage, StateReports, status_report
from omnid.transport.codec import DiagnosticStatus

Report: TypeAlias = Callable[[RunStatistics], list[DiagnosticStatus]]


class Recorder:
    """Writes every message under `/<robot>/`, and the report of the run at the end; `attachments` come first.

    The file is opened for the first message: a run that has none leaves what was there.
    """

    def __init__(self, path: Path, attachments: Mapping[str, bytes], robot: str, encode: Encoder) -> None:
        self._path, self._attachments = path, attachments
        self._writer: LogWriter | None = None
        self._robot, self._encode, self._states = robot, encode, StateReports()
        self._newest_ns = 0
        self._tally = RunStatistics()  # its own: the end of the run may reach others later
        self.report: Report = lambda _: []

    def process(self, message: Outgoing) -> None:
        """Adds what there is to say about a message."""
        self._newest_ns = max(self._newest_ns, message.stamp_ns)
        self._write(self._encode(message), message.stamp_ns)
        if isinstance(message, OdometryUpdate):
            self._tally.process(message)
            self._write(self._states(message), message.stamp_ns)

    def finish(self) -> None:
        """Makes the file whole."""
        if self._writer is None:
            return
        self._write([status_report(self._newest_ns, self.report(self._tally))], self._newest_ns)
        self.close()

    def close(self) -> None:
        """Ends the file as it is; a second call does nothing."""
        if self._writer is not None:
            self._writer.close()

    def _write(self, messages: Iterable[OutgoingMessage], stamp_ns: int) -> None:
        if self._writer is None:
            self._writer = LogWriter(self._path, self._attachments)
        for topic, schema, payload in messages:
            name = topic if topic.startswith("/") else f"/{self._robot}/{topic}"
            self._writer.write(name, schema, payload, stamp_ns)
