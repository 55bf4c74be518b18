"""Processor time a pair of each step inside each stage: `python -m tests.benchmark.budget FOLDER [--runs N]`.

The folder holds log.mcap and a rig.toml or camchain.yaml. All stages run inline in one thread, whose processor time is
measured. So that figures of different machines and loads compare, they are also given as ratios to reference kernels
that are timed in the same run on the same panoramas: one StereoSGBM, and one Lucas-Kanade call.
"""

from __future__ import annotations

import argparse
import os
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from statistics import median
from tempfile import TemporaryDirectory
from typing import Final

import cv2
import numpy as np
from numpy.typing import NDArray

from drivers.logs.log_reader import LogReader
from omnid.config import Config, load_config
from omnid.engine.graph import Graph, Sink
from omnid.engine.kernel_cache import prepare_kernels
from omnid.messages import OdometryUpdate
from omnid.runs.pipeline import Sinks, wire
from omnid.sinks.files import MapFile, TrajectoryFile
from omnid.stages.front_end import FrontEnd
from omnid.stages.geometry import geometry, with_rims
from omnid.stages.synchronise import Synchronise
from tests.benchmark.accuracy import rig_of
from tests.benchmark.budget_steps import STEPS, StepClock, measured_steps
from tests.benchmark.reference_kernels import LK_CORNERS, ReferenceKernels
from tests.benchmark.results import Cell, Column, ResultTable
from tests.busy import busy_processes
from tests.replay.test_memory import to_and_fro

REFERENCE_EVERY: Final = 10  # pairs between two runs of the reference kernels
SKIPPED: Final = 10  # first pairs, in which caches, buffers and the first map are filled
Image = NDArray[np.uint8]
Labels = tuple[str, ...]
COLUMNS: Final = (
    Column("step"),
    Column("time a pair", "ms", 2),
    Column("of SGBM + LK", "", 3),
    Column("calls a pair", "", 2),
)


@dataclass(frozen=True, slots=True)
class Budget:
    """Result of one run. Paths are the labels of a step and of those around it; () is what no stage did."""

    own_ms: dict[Labels, float]  # processor time a pair, without inner steps
    calls: dict[Labels, float]  # a pair
    sgbm_ms: float
    lk_ms: float

    def total_ms(self, path: Labels) -> float:
        """Return the time a pair of a step with its inner steps."""
        return sum(own for labels, own in self.own_ms.items() if labels[: len(path)] == path)


class ReferenceTimes:
    """A sink of poses that times the reference kernels on the panoramas of some pairs [ns]."""

    def __init__(self, clock: StepClock) -> None:
        self._clock, self._kernels = clock, ReferenceKernels()
        self.sgbm_ns: list[int] = []
        self.lk_ns: list[int] = []
        self._before: Image | None = None

    def process(self, odometry: OdometryUpdate) -> None:
        """Time the kernels at every REFERENCE_EVERY-th pair; after the first pairs, forget the steps so far."""
        if odometry.seq == SKIPPED - 1:
            self._clock.clear()
        pair = odometry.depth.panoramas
        lower, before = np.ascontiguousarray(pair.lower.panorama), self._before
        self._before = lower
        if odometry.seq % REFERENCE_EVERY or before is None:
            return
        self.sgbm_ns.append(self._kernels.sgbm_ns(lower, pair.upper.panorama))
        self.lk_ns.append(self._kernels.lucas_kanade_ns(before, lower))


def run_replay(
    graph: Graph, folder: Path, pairs: int, hz: float, config: Config, work: Path, sink: Sink[OdometryUpdate]
) -> None:
    """Run the stages of a replay over so many pairs, hz a second, to and fro through a log; sink: gets the poses, too.

    work: folder for the files of the replay.
    """
    frames = list(LogReader(folder / "log.mcap").frames())
    place = geometry(with_rims(rig_of(folder), frames), config.panorama)
    cv2.setNumThreads(config.graph.opencv_threads)
    sinks = Sinks({"trajectory": TrajectoryFile(work / "t"), "measured": sink}, {"map": MapFile(work / "m")})
    read = graph.source("read", lambda: to_and_fro(frames, pairs, round(1e9 / hz)))
    paired = graph.stage("pair", Synchronise(place.rig, config.pair), read)
    wire(graph, paired, FrontEnd(place, config), config, sinks)
    graph.run()


def measure(folder: Path, pairs: int, hz: float, overrides: Sequence[str]) -> Budget:
    """Run the stages inline over so many pairs, hz a second, to and fro through the log, and return the times."""
    prepare_kernels()  # else the first call of each compiles it, in a pair that counts
    config = load_config(None, overrides)
    clock = StepClock()
    reference = ReferenceTimes(clock)
    with TemporaryDirectory() as work, measured_steps(clock):
        graph = Graph(threaded=False)
        run_replay(graph, folder, pairs, hz, config, Path(work), reference)
    count = pairs - SKIPPED
    return Budget(
        {path: ns * 1e-6 / count for path, ns in clock.own_ns.items()},
        {path: calls / count for path, calls in clock.calls.items()},
        1e-6 * median(reference.sgbm_ns),
        1e-6 * median(reference.lk_ns),
    )


def rows(budgets: Sequence[Budget]) -> Iterator[list[Cell]]:
    """Yield the rows of the medians over the runs: stages and their steps, in the order of the flow."""
    sgbm_ms, lk_ms = (median(getattr(budget, name) for budget in budgets) for name in ("sgbm_ms", "lk_ms"))
    order = {step.label: number for number, step in enumerate(STEPS)}
    paths = sorted({path for budget in budgets for path in budget.own_ms if path}, key=lambda p: [order[x] for x in p])
    yield from (_row(budgets, path) for path in paths)
    stages = [sum(budget.total_ms(path) for path in paths if len(path) == 1) for budget in budgets]
    ratios = [ms / (budget.sgbm_ms + budget.lk_ms) for ms, budget in zip(stages, budgets, strict=True)]
    yield ["all stages", median(stages), median(ratios), None]
    yield ["reference: StereoSGBM", sgbm_ms, None, None]
    yield [f"reference: LK of {LK_CORNERS} corners", lk_ms, None, None]


def _row(budgets: Sequence[Budget], path: Labels) -> list[Cell]:
    """Return the row of a step: total of a stage, own time of the steps inside, with their path."""
    inner = len(path) > 1
    spent = [budget.own_ms.get(path, 0.0) if inner else budget.total_ms(path) for budget in budgets]
    ratio = median(ms / (budget.sgbm_ms + budget.lk_ms) for ms, budget in zip(spent, budgets, strict=True))
    calls = median(budget.calls.get(path, 0.0) for budget in budgets)
    return [" > ".join(path), median(spent), ratio, calls]


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path, metavar="FOLDER")
    parser.add_argument("--pairs", type=int, default=200, help="pairs of a run (default: %(default)s)")
    parser.add_argument(
        "--hz",
        type=float,
        default=10.0,
        help="pairs a second by their stamps, whatever the log's own "
        "rate is: the map takes at most 5 a second; the motion from pair to pair stays (default: %(default)s)",
    )
    parser.add_argument("--runs", type=int, default=5, help="runs, of which the medians are printed (default: 5)")
    parser.add_argument("--busy", type=int, default=0, metavar="N", help="computing processes per core beside it")
    parser.add_argument("--set", action="append", default=[], metavar="SECTION.KEY=VALUE", dest="overrides")
    args = parser.parse_args()
    if args.pairs < SKIPPED + 2 * REFERENCE_EVERY or args.runs < 1 or args.hz <= 0:
        parser.error(f"--pairs is at least {SKIPPED + 2 * REFERENCE_EVERY}, --runs at least 1, --hz above 0")
    with busy_processes(args.busy * (os.cpu_count() or 1)):
        budgets = [measure(args.folder, args.pairs, args.hz, args.overrides) for _ in range(args.runs)]
    table = ResultTable("budget", "speed", f"Processor time of a pair, {args.hz:g} Hz by the stamps", COLUMNS)
    for row in rows(budgets):
        table.add(*row)


if __name__ == "__main__":
    main()
