"""Progress of a run, as a bar on a terminal or as lines in a journal."""

from __future__ import annotations

import os
import sys
import time
from typing import TextIO

from omnid.diagnostics.run_summary import RunStatistics
from omnid.messages import OdometryUpdate

TERMINAL_PERIOD_S = 0.2
JOURNAL_PERIOD_S = 5.0
BAR_COLUMNS = 24
DEFAULT_COLUMNS = 80  # Used for a terminal that does not report its size.


class Progress:
    """The action of a ticker: draws a bar, or writes a line where the stream is no terminal."""

    def __init__(self, statistics: RunStatistics, expected: int | None, stream: TextIO | None = None) -> None:
        self._statistics, self._expected = statistics, expected
        self._stream = stream or sys.stderr
        self._terminal = self._stream.isatty()
        self._start_s = time.monotonic()
        self._drawn = 0

    @property
    def period_s(self) -> float:
        """Time between two calls."""
        return TERMINAL_PERIOD_S if self._terminal else JOURNAL_PERIOD_S

    def __call__(self) -> None:
        """Show the progress now."""
        newest = self._statistics.newest
        if newest is not None:
            self._show(self._line(newest))

    def close(self) -> None:
        """Clear the bar."""
        if self._terminal and self._drawn:
            self._write("\r" + " " * self._drawn + "\r")

    def _line(self, newest: OdometryUpdate) -> str:
        done = newest.seq + 1  # with the pairs that were dropped
        dropped = done - self._statistics.poses
        rate = done / max(1e-3, time.monotonic() - self._start_s)
        losses = f"  {dropped} dropped" if dropped > 0 else ""
        return f"{self._share(done)} {rate:5.1f} pairs/s  {self._statistics.length_m:8.2f} m  {newest.state}{losses}"

    def _share(self, done: int) -> str:
        if not self._expected:
            return f"{done} pairs"
        filled = min(BAR_COLUMNS, BAR_COLUMNS * done // self._expected)
        bar = f"[{'#' * filled}{'.' * (BAR_COLUMNS - filled)}] " if self._terminal else ""
        return f"{bar}{done}/{self._expected}"

    def _show(self, line: str) -> None:
        if self._terminal:
            line = line[: self._columns() - 1]  # a wrapped line could not be overwritten
            self._write("\r" + line.ljust(self._drawn))
            self._drawn = len(line)
        else:
            self._write(f"omnid: {line}\n")

    def _columns(self) -> int:
        try:
            return os.get_terminal_size(self._stream.fileno()).columns or DEFAULT_COLUMNS
        except OSError:
            return DEFAULT_COLUMNS

    def _write(self, text: str) -> None:
        try:
            self._stream.write(text)
            self._stream.flush()
        except OSError:  # the reader has gone: no reason to end the run
            self._stream = open("/dev/null", "w", encoding="ascii")  # noqa: SIM115 - lives as long as the run
