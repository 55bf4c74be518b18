"""The wiring of the stages."""

from __future__ import annotations

import pytest

from drivers.frame import Frame
from omnid.engine.graph import Graph
from omnid.messages import OdometryUpdate
from omnid.runs.pipeline import Sinks, wire
from omnid.stages.geometry import Geometry
from tests.conftest import PAIRS
from tests.omnid.stages.scene_parts import CONFIG, front_end, paired


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
