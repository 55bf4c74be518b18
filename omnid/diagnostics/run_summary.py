"""Counters of a run, and their summary in words."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from textwrap import wrap
from typing import Final

import numpy as np
from numpy.typing import NDArray

from omnid.core.stereo.tiles import Side
from omnid.engine.telemetry import SummaryRow
from omnid.messages import OdometryUpdate
from omnid.tracking_state import TrackingState


class RunStatistics:
    """A sink that counts poses; other threads may read its attributes meanwhile."""

    def __init__(self) -> None:
        self.poses = 0
        self.length_m = 0.0
        self.states: Counter[str] = Counter()
        self.resets = 0
        self.dark = 0  # pairs that were too dark
        self.lost_parts: Counter[Side] = Counter()  # pairs in which a part of a camera's image was frozen or blind
        self.too_fast = 0  # pairs whose pose was refused for its speed alone
        self.fastest_mps = 0.0  # of those
        self.newest: OdometryUpdate | None = None
        self._position: NDArray[np.float64] | None = None

    def process(self, odometry: OdometryUpdate) -> None:
        """Count a pose."""
        # 1. The way.
        position = odometry.T_odom_rig[:3, 3]
        if self._position is not None:
            self.length_m += float(np.linalg.norm(position - self._position))
        self._position, self.newest = position, odometry
        # 2. States of poses and images.
        self.states[odometry.state] += 1
        self.dark += odometry.light.is_too_dark
        columns = odometry.depth.panoramas.tiles.columns
        self.lost_parts.update(side for side, found in columns.items() if found.any())
        self.resets = odometry.reset_counter
        self.too_fast += odometry.refused_mps > 0
        self.fastest_mps = max(self.fastest_mps, odometry.refused_mps)
        self.poses += 1


@dataclass(frozen=True, slots=True)
class RunCounters:
    """Counts of a run over a log."""

    pairs: int  # of images
    poses: int
    length_m: float  # of the path
    states: Mapping[TrackingState, int]  # poses in each state
    resets: int  # gaps in the trajectory after which tracking began again
    drops: Mapping[str, int]  # messages lost, by reason; zeros too
    map: Mapping[str, int] = field(default_factory=dict)  # voxels and points; empty without a map
    places: Mapping[str, int] = field(default_factory=dict)  # keyframes, loops, refusals; empty without a map of places
    motor: Mapping[str, int] = field(default_factory=dict)  # commands, errors, stops; empty without a motor

    @property
    def no_pose(self) -> bool:
        """True if no pose was measured: there are none, or all are predictions."""
        return self.poses == self.states[TrackingState.LOST]

    @classmethod
    def of(cls, statistics: RunStatistics, pairs: int, drops: Mapping[str, int]) -> RunCounters:
        """Return the counters of a run from its statistics."""
        states = {state: statistics.states[state] for state in TrackingState}
        return cls(pairs, statistics.poses, statistics.length_m, states, statistics.resets, drops)


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
