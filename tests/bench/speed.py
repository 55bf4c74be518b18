"""Processor time of a pair by its stages: `python -m tests.bench.speed FOLDER [--runs N]`.

The folder holds log.mcap and a rig.toml or camchain.yaml. All stages run inline in one thread, whose processor time is
measured. So that figures of different machines and loads compare, they are also given as ratios to reference kernels
that are timed in the same run on the same panoramas: one StereoSGBM, and one Lucas-Kanade call.
"""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from pathlib import Path
from statistics import median
from tempfile import TemporaryDirectory
from typing import Any, Final

import cv2
import numpy as np
from numpy.typing import NDArray

from drivers.logs.log_reader import LogReader
from omnid.config import load_config
from omnid.engine.graph import Graph, no_op
from omnid.engine.kernel_cache import prepare_kernels
from omnid.formats.exports import write_ply
from omnid.messages import OdometryUpdate
from omnid.runs.files import RunPlaces
from omnid.runs.wiring import Inputs, wire
from omnid.sinks.files import TrajectoryFile
from omnid.stages.front_end import FrontEnd
from omnid.stages.geometry import Dewarp, geometry, with_rims
from omnid.stages.mapping import Mapping
from omnid.stages.synchronise import Synchronise
from tests.bench.accuracy import rig_of
from tests.bench.results import ResultTable, columns, lucas_kanade_ns, run, sgbm_ns
from tests.replay.test_outputs import to_and_fro

REFERENCE_EVERY: Final = 10  # pairs between two runs of the reference kernels
SKIPPED: Final = 10  # first pairs, in which caches, buffers and the first map are filled
STAGES: Final[dict[str, type]] = {
    "pair": Synchronise,
    "dewarp": Dewarp,
    "odometry": FrontEnd,
    "dense stereo and mapping": Mapping,
}


class StageClock:
    """Processor time of the calling thread [ns] within the stages, and within the reference kernels."""

    def __init__(self) -> None:
        self.stage_ns: Counter[str] = Counter()
        self.kernels_ns: dict[str, list[int]] = {"StereoSGBM": [], "Lucas-Kanade": []}
        self._before: NDArray[np.uint8] | None = None

    def process(self, odometry: OdometryUpdate) -> None:
        """Time the kernels at every REFERENCE_EVERY-th pair, as a sink; forget the stages of the first pairs."""
        if odometry.seq == SKIPPED - 1:
            self.stage_ns.clear()
        pair = odometry.depth.panoramas
        lower, before = np.ascontiguousarray(pair.lower.panorama), self._before
        self._before = lower
        if before is not None and odometry.seq % REFERENCE_EVERY == 0:
            self.kernels_ns["StereoSGBM"].append(sgbm_ns(lower, pair.upper.panorama))
            self.kernels_ns["Lucas-Kanade"].append(lucas_kanade_ns(before, lower))

    @contextmanager
    def timed_stages(self) -> Iterator[None]:
        """Time the method `process` of the stages within the block."""
        with ExitStack() as ends:
            for label, stage in STAGES.items():
                ends.callback(setattr, stage, "process", stage.process)  # type: ignore[attr-defined]
                stage.process = self._timed(label, stage.process)  # type: ignore[attr-defined]
            yield

    def _timed(self, label: str, call: Callable[..., Any]) -> Callable[..., Any]:
        def measured(*args: Any) -> Any:
            start_ns = time.thread_time_ns()
            try:
                return call(*args)
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
        read = graph.source("read", lambda: to_and_fro(frames, pairs, round(1e9 / hz)))
        streams = wire(config, Inputs([read], RunPlaces(config, place, no_op)), FrontEnd(place, config), graph)
        graph.sink("trajectory", trajectory, streams.poses)
        graph.sink("measured", clock, streams.poses)
        graph.sink("map", lambda update: write_ply(cloud, update.points), streams.maps)
        graph.run()
    found = {label: 1e-6 * spent_ns / (pairs - SKIPPED) for label, spent_ns in clock.stage_ns.items()}
    found["all stages"] = sum(found.values())
    return found | {name: 1e-6 * median(spent_ns) for name, spent_ns in clock.kernels_ns.items()}


def speed(folder: Path, *, pairs: int = 200, hz: float = 10.0, runs: int = 5, set_: Sequence[str] = ()) -> None:
    """Print the medians of some runs of so many pairs, hz of them a second by their stamps."""
    if pairs < SKIPPED + 2 * REFERENCE_EVERY:
        raise SystemExit(f"--pairs is at least {SKIPPED + 2 * REFERENCE_EVERY}")
    head = columns("stage", "time a pair|ms|2", "of SGBM + LK||3")
    table = ResultTable("speed", f"Processor time of a pair, {hz:g} Hz by the stamps", head, timed=True)
    found = [measure(folder, pairs, hz, set_) for _ in range(runs)]
    for label in found[0]:
        ratios = [each[label] / (each["StereoSGBM"] + each["Lucas-Kanade"]) for each in found]
        table.add(label, median(each[label] for each in found), median(ratios))


if __name__ == "__main__":
    run(speed)
