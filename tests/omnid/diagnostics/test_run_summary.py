"""The summary of a run fits the terminal, and has one line for each counter where there is none."""

from __future__ import annotations

from omnid.diagnostics.run_statistics import RunCounters, RunStatistics
from omnid.diagnostics.run_summary import run_summary, summary_entries

COUNTERS = RunCounters.of(RunStatistics(), 99, {f"unpaired_{number}": 10**number for number in range(9)})


def test_long_counters_are_folded_between_words() -> None:
    for columns in (80, 60):
        lines = run_summary(COUNTERS, [], columns).splitlines()
        start = next(number for number, line in enumerate(lines) if line.startswith("drops"))
        folded = [line for line in lines[start:] if line.startswith(("drops", " " * 10))]
        assert max(map(len, lines)) <= columns and len(folded) > 2
        assert " ".join(line[10:] for line in folded) == summary_entries(COUNTERS)["drops"]


def test_programs_read_one_line_for_each_counter() -> None:
    assert f"drops     {summary_entries(COUNTERS)['drops']}" in run_summary(COUNTERS, []).splitlines()
