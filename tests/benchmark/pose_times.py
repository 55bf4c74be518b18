"""Processor time of odometry until a pose is given out, and after it: `python -m tests.benchmark.pose_times [LOG]`.

All stages run inline in one thread. LOG is an MCAP file with its rig attached; without it, the sample.
"""

from __future__ import annotations

import argparse
from importlib.resources import files
from pathlib import Path

import cv2
import numpy as np

from calib.rig_file import parse_rig
from drivers.logs.log_reader import LogReader
from omnid.config import load_config
from omnid.engine.graph import Graph
from omnid.engine.kernel_cache import prepare_kernels
from omnid.messages import OdometryUpdate
from omnid.runs.pipeline import Sinks, wire
from omnid.stages.front_end import FrontEnd
from omnid.stages.geometry import geometry, with_rims
from omnid.stages.odometry import OdometryStage
from omnid.stages.synchronise import Synchronise
from tests.benchmark.budget_steps import StepClock
from tests.benchmark.results import Column, ResultTable
from tests.replay.test_memory import to_and_fro

SKIPPED = 5  # first pairs, in which caches and the first map are filled


class Times:
    """A sink of poses; the times of each pair [ms]."""

    def __init__(self, clock: StepClock) -> None:
        self.until_pose: list[float] = []
        self.after_pose: list[float] = []
        self._clock = clock

    def process(self, odometry: OdometryUpdate) -> None:
        """Keep the time of this pose, and what followed the one before."""
        spent = self._clock.own_ns
        self.until_pose.append(spent["pose",] * 1e-6)
        self.after_pose.append(spent["after",] * 1e-6)
        self._clock.clear()


def main() -> None:
    """Print a row for each of both."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("log", type=Path, nargs="?", default=Path(str(files("omnid.sample") / "log.mcap")))
    parser.add_argument("--pairs", type=int, default=200)
    parser.add_argument("--hz", type=float, default=30.0, help="pairs a second by their stamps")
    args = parser.parse_args()
    prepare_kernels(lambda _level, _text: None)  # their compilation is no part of the times
    reader, config, clock = LogReader(args.log), load_config(None, ()), StepClock()
    frames, rig = list(reader.frames()), parse_rig(reader.attachments()["rig.toml"])
    place, times = geometry(with_rims(rig, frames), config.panorama), Times(clock)
    cv2.setNumThreads(1)
    process, after = OdometryStage.process, OdometryStage.after
    OdometryStage.process = clock.timed("pose", process)  # type: ignore[method-assign]
    OdometryStage.after = clock.timed("after", after)  # type: ignore[method-assign]
    graph = Graph(threaded=False)
    read = graph.source("read", lambda: to_and_fro(frames, args.pairs, round(1e9 / args.hz)))
    pairs = graph.stage("pair", Synchronise(place.rig, config.pair), read)
    wire(graph, pairs, FrontEnd(place, config), config, Sinks({"times": times}))
    graph.run()
    columns = (
        Column("time of odometry"),
        *(Column(name, "ms", 1) for name in ("p50", "p90", "p99", "mean")),
        Column("pairs above 1 ms", "%", 0),
    )
    table = ResultTable("pose_times", "speed", "Processor time of odometry until a pose and after it", columns)
    for label, all_ms in (("until the pose", times.until_pose), ("after it", times.after_pose)):
        ms = np.array(all_ms[SKIPPED:])
        p50, p90, p99 = np.percentile(ms, [50, 90, 99])
        table.add(label, p50, p90, p99, ms.mean(), 100 * np.mean(ms > 1))


if __name__ == "__main__":
    main()
