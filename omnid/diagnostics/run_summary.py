"""The summary of a run as text: what everybody wants to know, or all counters and the times of the stages."""

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
    entries = {
        "pairs": str(counters.pairs),
        "poses": str(counters.poses),
        "length": f"{counters.length_m:.4f} m",
        "states": states,
        "resets": str(counters.resets),
        "drops": _listed(counters.drops),
    }
    if counters.map:
        entries["map"] = _listed(counters.map)
    if counters.places:
        entries["places"] = _listed(counters.places)
    if counters.motor:
        motor = counters.motor
        entries["motor"] = f"{motor['commands']} commands sent, {motor['errors']} errors, {motor['stops']} stops"
    return entries


def brief_entries(counters: RunCounters) -> dict[str, str]:
    """Return what everybody wants to know: what was lost, if anything, and last the length and the states."""
    entries = summary_entries(counters)
    lost = {name: count for name, count in counters.drops.items() if count}
    states = {state: count for state, count in counters.states.items() if count}
    shown = {"poses": f"{counters.poses} of {counters.pairs} pairs of images"}
    if lost:
        shown["lost"] = _listed(lost)
    if counters.resets:
        shown["resets"] = f"{counters.resets}, after gaps in which the motion is unknown"
    if counters.motor:
        shown["motor"] = entries["motor"]
    shown["length"] = entries["length"]
    shown["states"] = ", ".join(f"{state} {_share(count, counters.poses)}" for state, count in states.items())
    return shown


def run_summary(
    counters: RunCounters, timings: Iterable[SummaryRow], columns: int = 0, *, verbose: bool = False
) -> str:
    """Return the counters, one a line.

    verbose: with a row for each stage that processed messages, and with all counters, zeros too. columns: of the
    terminal, whose width no line exceeds; 0: each counter has one line, as programs read it.
    """
    lines = []
    if verbose:
        lines = [f"{'stage':<11}{'n':>8}{'drops':>7}{'p50 ms':>9}{'p99 ms':>9}{'max ms':>9}"]
        lines += [
            f"{r.stage:<11}{r.n:>8}{r.drops:>7}{r.p50_ms:>9.2f}{r.p99_ms:>9.2f}{r.max_ms:>9.2f}" for r in timings if r.n
        ]
        lines.append("")
    entries = summary_entries(counters) if verbose else brief_entries(counters)
    lines += [line for name, text in entries.items() for line in folded_entry(name, text, columns)]
    return "\n".join(lines)


def folded_entry(name: str, text: str, columns: int) -> list[str]:
    """Return an entry as lines of at most `columns` columns; the texts stay below each other. 0: as one line."""
    line = f"{name:<{_NAME_COLUMNS}} {text}"
    if columns <= 2 * _NAME_COLUMNS:
        return [line]
    return wrap(line, columns, subsequent_indent=" " * (_NAME_COLUMNS + 1), break_long_words=False)


def _listed(counts: Mapping[str, int]) -> str:
    return ", ".join(f"{name} {count}" for name, count in counts.items())


def _share(count: int, total: int) -> str:
    return f"{count / total:.1%}" if total else "0 %"
