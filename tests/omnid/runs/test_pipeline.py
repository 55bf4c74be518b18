"""The wiring of the stages."""

from __future__ import annotations

from pathlib import Path

import pytest

from calib.rig_file import read_rig
from drivers.frame import Frame
from drivers.logs.log_reader import LogReader
from omnid.config import Config
from omnid.engine.graph import Graph, Stream
from omnid.messages import FramePair, OdometryUpdate
from omnid.runs.pipeline import Sinks, wire
from omnid.stages.front_end import FrontEnd
from omnid.stages.geometry import Geometry, geometry
from omnid.stages.synchronise import Synchronise
from tests.conftest import PAIRS

CONFIG = Config()


@pytest.fixture(scope="module")
def frames(scene: Path) -> list[Frame]:
    return list(LogReader(scene / "log.mcap").frames())


@pytest.fixture(scope="module")
def rig_geometry(scene: Path) -> Geometry:
    return geometry(read_rig(scene / "rig.toml"), CONFIG.panorama)


def front_end(rig_geometry: Geometry) -> FrontEnd:
    return FrontEnd(rig_geometry, CONFIG)


def paired(graph: Graph, rig_geometry: Geometry, frames: list[Frame]) -> tuple[Synchronise, Stream[FramePair]]:
    pair = Synchronise(rig_geometry.rig, CONFIG.pair)
    return pair, graph.stage("pair", pair, graph.source("read", lambda: frames))


@pytest.mark.parametrize("threaded", [True, False])
def test_the_pipeline_reads_any_iterable_of_frames(rig_geometry: Geometry, frames: list[Frame], threaded: bool) -> None:
    poses: list[OdometryUpdate] = []

    class Keep:
        def process(self, message: OdometryUpdate) -> None:
            poses.append(message)

    graph = Graph(threaded=threaded)
    pair, pairs = paired(graph, rig_geometry, frames)
    wire(graph, pairs, front_end(rig_geometry), CONFIG, Sinks(poses={"keep": Keep()}))
    graph.run()
    assert [p.seq for p in poses] == list(range(PAIRS)) and pair.counts["pairs"] == PAIRS
