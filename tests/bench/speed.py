"""Processor time of a pair by its stages: `python -m tests.bench.speed FOLDER [--runs N]`.

The folder holds log.mcap and a rig.toml or camchain.yaml. All stages run inline in one thread, whose processor time is
measured. So that figures of different machines and loads compare, they are also given as ratios to reference kernels
that are timed in the same run on the same panoramas: one StereoSGBM, and one Lucas-Kanade call.
"""

from __future__ import annotations

import argparse
import time
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from functools import wraps
from importlib import import_module
from pathlib import Path
from statistics import median
from tempfile import TemporaryDirectory
from typing import Any, Final

import cv2
import numpy as np
from numpy.typing import NDArray

from drivers.logs.log_reader import LogReader
from omnid.config import load_config
from omnid.engine.graph import Graph
from omnid.engine.kernel_cache import prepare_kernels
from omnid.formats.exports import write_ply
from omnid.messages import OdometryUpdate
from omnid.runs.wiring import Outputs, wire
from omnid.sinks.files import TrajectoryFile
from omnid.stages.front_end import FrontEnd
from omnid.stages.geometry import geometry, with_rims
from tests.bench.accuracy import rig_of
from tests.bench.reference_kernels import ReferenceKernels
from tests.bench.results import Column, ResultTable
from tests.replay.test_memory import to_and_fro

REFERENCE_EVERY: Final = 10  # pairs between two runs of the reference kernels
SKIPPED: Final = 10  # first pairs, in which caches, buffers and the first map are filled
STAGES: Final = {  # label: the class of a stage, whose method `process` is timed
    "pair": "omnid.stages.synchronise.Synchronise",
    "dewarp": "omnid.stages.dewarp.Dewarp",
    "odometry": "omnid.stages.odometry.OdometryStage",
    "dense stereo and mapping": "omnid.stages.mapping.Mapping",
}


class StageClock:
    """Processor time of the calling thread [ns] within the stages, and within the reference kernels."""

    def __init__(self) -> None:
        self.stage_ns: Counter[str] = Counter()
        self.sgbm_ns: list[int] = []
        self.lk_ns: list[int] = []
        self._kernels = ReferenceKernels()
        self._before: NDArray[np.uint8] | None = None

    def process(self, odometry: OdometryUpdate) -> None:
        """Time the kernels at every REFERENCE_EVERY-th pair, as a sink; forget the stages of the first pairs."""
        if odometry.seq == SKIPPED - 1:
            self.stage_ns.clear()
        pair = odometry.depth.panoramas
        lower, before = np.ascontiguousarray(pair.lower.panorama), self._before
        self._before = lower
        if before is not None and odometry.seq % REFERENCE_EVERY == 0:
            self.sgbm_ns.append(self._kernels.sgbm_ns(lower, pair.upper.panorama))
            self.lk_ns.append(self._kernels.lucas_kanade_ns(before, lower))

    @contextmanager
    def timed_stages(self) -> Iterator[None]:
        """Time the stages within the block."""
        with ExitStack() as ends:
            for label, name in STAGES.items():
                module, _, owner_name = name.rpartition(".")
                owner = getattr(import_module(module), owner_name)
                ends.callback(setattr, owner, "process", owner.process)
                owner.process = self._timed(label, owner.process)
            yield

    def _timed(self, label: str, call: Callable[..., Any]) -> Callable[..., Any]:
        @wraps(call)
        def measured(*args: Any, **kwargs: Any) -> Any:
            start_ns = time.thread_time_ns()
            try:
                return call(*args, **kwargs)
            finally:
                self.stage_ns[label] += time.thread_time_ns() - start_ns

        return measured


def measure(folder: Path, pairs: int, hz: float, overrides: Sequence[str]) -> dict[str, float]:
    """Run the stages inline to and fro through a log; return processor times a pair [ms] and of the kernels [ms]."""
    prepare_kernels()  # else the first call of each compiles it, in a pair that counts
    config, clock = load_config(None, overrides), StageClock()
    frames = list(LogReader(folder / "log.mcap").frames())
    place = geometry(with_rims(rig_of(folder), frames), config.panorama)
    cv2.setNumThreads(1)  # as a run does
    with TemporaryDirectory() as work, clock.timed_stages():
        graph = Graph(threaded=False)
        trajectory, cloud = TrajectoryFile(Path(work) / "t"), Path(work) / "m"
        outputs = Outputs(
            poses={"trajectory": trajectory, "measured": clock},
            maps={"map": lambda update: write_ply(cloud, update.points)},
        )
        read = graph.source("read", lambda: to_and_fro(frames, pairs, round(1e9 / hz)))
        wire(graph, [read], FrontEnd(place, config), config, outputs)
        graph.run()
    found = {label: 1e-6 * spent_ns / (pairs - SKIPPED) for label, spent_ns in clock.stage_ns.items()}
    found["all stages"] = sum(found.values())
    return found | {"StereoSGBM": 1e-6 * median(clock.sgbm_ns), "Lucas-Kanade": 1e-6 * median(clock.lk_ns)}


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path, metavar="FOLDER")
    parser.add_argument("--pairs", type=int, default=200, help="pairs of a run (default: %(default)s)")
    parser.add_argument("--hz", type=float, default=10.0, help="pairs a second by their stamps (default: %(default)s)")
    parser.add_argument("--runs", type=int, default=5, help="runs, of which the medians are printed (default: 5)")
    parser.add_argument("--set", action="append", default=[], metavar="SECTION.KEY=VALUE", dest="overrides")
    args = parser.parse_args()
    if args.pairs < SKIPPED + 2 * REFERENCE_EVERY or args.runs < 1 or args.hz <= 0:
        parser.error(f"--pairs is at least {SKIPPED + 2 * REFERENCE_EVERY}, --runs at least 1, --hz above 0")
    columns = (Column("stage"), Column("time a pair", "ms", 2), Column("of SGBM + LK", "", 3))
    table = ResultTable("speed", f"Processor time of a pair, {args.hz:g} Hz by the stamps", columns, timed=True)
    runs = [measure(args.folder, args.pairs, args.hz, args.overrides) for _ in range(args.runs)]
    for label in runs[0]:
        ratios = [run[label] / (run["StereoSGBM"] + run["Lucas-Kanade"]) for run in runs]
        table.add(label, median(run[label] for run in runs), median(ratios))


if __name__ == "__main__":
    main()
