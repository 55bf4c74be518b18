"""What is said at the end of a run."""

from __future__ import annotations

from collections.abc import Iterable, Mapping

from omnid.diagnostics.run_statistics import RunStatistics
from omnid.engine.telemetry import SummaryRow

QUIET_BOXES = ("progress", "tally")


def counters(tally: RunStatistics, dropped: Mapping[str, int]) -> dict[str, str]:
    """The counts of a run, by name."""
    states = {name: tally.states[name] for name in ("tracking", "degraded", "lost")}
    share = ", ".join(f"{name} {_share(count, tally.poses)}" for name, count in states.items())
    drops = ", ".join(f"{name} {count}" for name, count in dropped.items())
    return {"poses": str(tally.poses), "length": f"{tally.length_m:.4f} m", "states": share,
            "resets": str(tally.resets), "drops": drops}


def run_summary(values: Mapping[str, str], rows: Iterable[SummaryRow]) -> str:
    """The counters, and a table of the stages' times."""
    lines = [f"{name:<9} {value}" for name, value in values.items()]
    lines += ["", f"{'stage':<11}{'n':>8}{'drops':>7}{'p50 ms':>9}{'p99 ms':>9}{'max ms':>9}"]
    shown = (row for row in rows if row.stage not in QUIET_BOXES and row.n)
    lines += [f"{r.stage:<11}{r.n:>8}{r.drops:>7}{r.p50_ms:>9.2f}{r.p99_ms:>9.2f}{r.max_ms:>9.2f}" for r in shown]
    return "\n".join(lines)


def _share(count: int, of: int) -> str:
    return f"{count / of:.1%}" if of else "0 %"
