"""The summary of a run as text: its counters, and a table of the times of its stages."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from textwrap import wrap
from typing import Final

from omnid.diagnostics.run_statistics import RunCounters
from omnid.engine.telemetry import SummaryRow

_NAME_COLUMNS: Final = 9


def summary_entries(counters: RunCounters) -> dict[str, str]:
    """Return the counters as texts, by name."""
    states = ", ".join(f"{state} {_share(count, counters.poses)}" for state, count in counters.states.items())
    entries = {"pairs": str(counters.pairs), "poses": str(counters.poses), "length": f"{counters.length_m:.4f} m",
               "states": states, "resets": str(counters.resets), "drops": _listed(counters.drops)}
    if counters.map:
        entries["map"] = _listed(counters.map)
    if counters.places:
        entries["places"] = _listed(counters.places)
    if counters.motor:
        motor = counters.motor
        entries["motor"] = f"{motor['commands']} commands sent, {motor['errors']} errors, {motor['stops']} stops"
    return entries


def run_summary(counters: RunCounters, timings: Iterable[SummaryRow], columns: int = 0) -> str:
    """Return the counters, one a line, and a table with one row for each stage that processed messages.

    columns: of the terminal, whose width no line exceeds; 0: each counter has one line, as programs read it.
    """
    lines = [line for name, text in summary_entries(counters).items()
             for line in _folded(f"{name:<{_NAME_COLUMNS}} {text}", columns)]
    lines += ["", f"{'stage':<11}{'n':>8}{'drops':>7}{'p50 ms':>9}{'p99 ms':>9}{'max ms':>9}"]
    lines += [f"{r.stage:<11}{r.n:>8}{r.drops:>7}{r.p50_ms:>9.2f}{r.p99_ms:>9.2f}{r.max_ms:>9.2f}"
              for r in timings if r.n]
    return "\n".join(lines)


def _folded(line: str, columns: int) -> list[str]:
    """Return a line as lines of at most so many columns; the texts stay below each other."""
    if columns <= 2 * _NAME_COLUMNS:
        return [line]
    return wrap(line, columns, subsequent_indent=" " * (_NAME_COLUMNS + 1), break_long_words=False)


def _listed(counts: Mapping[str, int]) -> str:
    return ", ".join(f"{name} {count}" for name, count in counts.items())


def _share(count: int, total: int) -> str:
    return f"{count / total:.1%}" if total else "0 %"
