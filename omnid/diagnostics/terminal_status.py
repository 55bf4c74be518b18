"""The status of a run on a terminal: a line when it is ready, one that is rewritten, and a summary at the end."""

from __future__ import annotations

from collections.abc import Callable
from typing import Final

from omnid.diagnostics.run_statistics import RunStatistics

PERIOD_S: Final = 0.5


class TerminalStatus:
    """The action of a ticker: shows a line as long as the run lasts."""

    period_s = PERIOD_S

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
