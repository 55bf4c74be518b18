"""The summary of a run fits the terminal, and has one line for each counter where there is none."""

from __future__ import annotations

from collections import Counter

from omnid.diagnostics.run_summary import RunCounters, RunStatistics, run_summary, summary_entries

COUNTERS = RunCounters.of(RunStatistics(), 99, {f"unpaired_{number}": 10**number for number in range(9)})


def test_long_counters_are_folded_between_words() -> None:
    for columns in (80, 60):
        lines = run_summary(COUNTERS, [], columns, verbose=True).splitlines()
        start = next(number for number, line in enumerate(lines) if line.startswith("drops"))
        folded = [line for line in lines[start:] if line.startswith(("drops", " " * 10))]
        assert max(map(len, lines)) <= columns and len(folded) > 2
        assert " ".join(line[10:] for line in folded) == summary_entries(COUNTERS)["drops"]


def test_programs_read_one_line_for_each_counter() -> None:
    assert f"drops     {summary_entries(COUNTERS)['drops']}" in run_summary(COUNTERS, [], verbose=True).splitlines()


def test_what_everybody_wants_to_know_comes_last_and_zeros_are_left_out() -> None:
    statistics = RunStatistics()
    statistics.poses, statistics.length_m, statistics.states = 98, 4.82741, Counter({"tracking": 98})
    brief = run_summary(RunCounters.of(statistics, 99, {"late": 0, "queue": 1}), []).splitlines()
    assert brief == [
        "poses     98 of 99 pairs of images",
        "lost      queue 1",
        "length    4.8274 m",
        "states    tracking 100.0%",
    ]
