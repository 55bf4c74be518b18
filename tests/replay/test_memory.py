"""Constant memory in long runs: the sample forwards and backwards, repeated."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from importlib.resources import files
from itertools import cycle
from pathlib import Path

import numpy as np
import pytest

from calib.rig_file import parse_rig
from drivers.frame import Frame
from drivers.logs.log_reader import LogReader
from omnid.config import Config
from omnid.diagnostics.run_summary import RunStatistics
from omnid.engine.graph import Graph
from omnid.formats.exports import write_ply
from omnid.messages import OdometryUpdate
from omnid.runs.wiring import Inputs, Outputs, wire
from omnid.sinks.files import TrajectoryFile
from omnid.stages.front_end import FrontEnd
from omnid.stages.geometry import geometry, with_rims

PAIRS = 2000
PERIOD_NS = 100_000_000
SETTLED, GROWTH_MIB = 200, 12.0


def to_and_fro(frames: list[Frame], pairs: int, period_ns: int = PERIOD_NS) -> Iterator[Frame]:
    """Yield the frames of so many pairs, forwards and backwards, with rising stamps."""
    both = [frames[i : i + 2] for i in range(0, len(frames), 2)]
    path = cycle([*both, *both[-2:0:-1]])
    for k in range(pairs):
        for frame in next(path):
            yield replace(frame, stamp_ns=k * period_ns)


class MemoryMonitor:
    """A sink that measures the resident memory every hundred poses."""

    def __init__(self) -> None:
        self.mib: dict[int, float] = {}

    def process(self, odometry: OdometryUpdate) -> None:
        if odometry.seq % 100 == 99:
            status = Path("/proc/self/status").read_text().split("VmRSS:")[1]
            self.mib[odometry.seq + 1] = int(status.split()[0]) / 1024


@pytest.mark.slow
def test_memory_stays_constant(tmp_path: Path) -> None:
    reader = LogReader(Path(str(files("omnid.sample") / "log.mcap")))
    config, frames = Config(), list(reader.frames())
    place = geometry(with_rims(parse_rig(reader.attachments()["rig.toml"]), frames), config.panorama)
    monitor, statistics = MemoryMonitor(), RunStatistics()
    poses = {"monitor": monitor, "statistics": statistics, "trajectory": TrajectoryFile(tmp_path / "est.txt")}
    graph = Graph(threaded=True)
    ends = Outputs(poses=poses, maps={"map": lambda update: write_ply(tmp_path / "map.ply", update.points)})
    read = graph.source("read", lambda: to_and_fro(frames, PAIRS))
    wire(config, Inputs([read]), FrontEnd(place, config), graph, ends)
    graph.run()
    print(statistics.states, monitor.mib)
    assert statistics.poses == PAIRS
    later = np.array([mib for seq, mib in monitor.mib.items() if seq >= SETTLED])
    assert later.max() - later[0] < GROWTH_MIB
