"""The line of a live run on a terminal: ready once, rewritten, and a summary at the end."""

from __future__ import annotations

from collections import Counter

from omnid.diagnostics.run_summary import RunStatistics
from omnid.runs.live import TerminalStatus


def test_a_run_is_ready_once_and_ends_with_a_summary() -> None:
    shown, reported, statistics = list[str](), list[str](), RunStatistics()
    terminal = TerminalStatus(shown.append, lambda: "10 Hz", reported.append, statistics, "ready: go")
    terminal()
    statistics.length_m = 12.345
    terminal()
    assert shown == ["    0.00 m  10 Hz", "   12.35 m  10 Hz"] and reported == ["ready: go"]
    statistics.poses, statistics.resets, statistics.states = 4, 1, Counter({"tracking": 3, "lost": 1})
    terminal.close()
    assert shown[-1] == ""
    assert reported[-1] == "ended: 4 poses, 12.35 m, 1 resets; tracking 75.0%, lost 25.0%"
