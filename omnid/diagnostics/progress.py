"""Progress of a run, as a bar on a terminal or as lines in a journal."""

from __future__ import annotations

import os
import sys
import time
from contextlib import suppress
from typing import TextIO

from omnid.diagnostics.run_summary import RunStatistics

BAR_COLUMNS = 24


class Progress:
    """The action of a ticker: draws a bar, or writes a line where the stream is no terminal."""

    def __init__(self, statistics: RunStatistics, expected: int | None, stream: TextIO | None = None) -> None:
        self._statistics, self._expected = statistics, expected
        self._stream = stream or sys.stderr
        self._is_terminal = self._stream.isatty()
        self._start_s = time.monotonic()
        self._drawn = 0

    @property
    def period_s(self) -> float:
        """Time between two calls."""
        return 0.2 if self._is_terminal else 5.0

    def __call__(self) -> None:
        """Show the progress now."""
        newest = self._statistics.newest
        if newest is None:
            return
        done = newest.seq + 1  # with the pairs that were dropped
        rate, dropped = done / max(1e-3, time.monotonic() - self._start_s), done - self._statistics.poses
        line = f"{self._share(done)} {rate:5.1f} pairs/s  {self._statistics.length_m:8.2f} m  {newest.state}"
        line += f"  {dropped} dropped" if dropped > 0 else ""
        if not self._is_terminal:
            self._write(f"omnid: {line}\n")
            return
        columns = 0
        with suppress(OSError):
            columns = os.get_terminal_size(self._stream.fileno()).columns
        line = line[: (columns or 80) - 1]  # a wrapped line could not be overwritten
        self._write("\r" + line.ljust(self._drawn))
        self._drawn = len(line)

    def close(self) -> None:
        """Clear the bar."""
        if self._drawn:
            self._write("\r" + " " * self._drawn + "\r")

    def _share(self, done: int) -> str:
        if not self._expected:
            return f"{done} pairs"
        filled = min(BAR_COLUMNS, BAR_COLUMNS * done // self._expected)
        bar = f"[{'#' * filled}{'.' * (BAR_COLUMNS - filled)}] " if self._is_terminal else ""
        return f"{bar}{done}/{self._expected}"

    def _write(self, text: str) -> None:
        with suppress(OSError):  # the reader has gone: no reason to end the run
            self._stream.write(text)
            self._stream.flush()
