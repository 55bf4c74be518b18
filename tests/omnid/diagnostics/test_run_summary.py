"""The summary of a run ends with what everybody wants to know."""

from __future__ import annotations

from collections import Counter

from omnid.diagnostics.run_summary import RunCounters, RunStatistics, run_summary


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
