"""Pairs per second through the whole pipeline and the time of each stage: `python -m pytest -m benchmark -s`.

OMNID_BENCHMARK_PROFILE: a profile, such as small.
"""

from __future__ import annotations

import os
import time
from importlib.resources import files
from pathlib import Path

import cv2
import pytest

from calib.kalibr import import_kalibr
from calib.rig import Rig
from calib.rig_file import parse_rig
from drivers.logs.log_reader import LogReader
from omnid.commands.options import PROFILES
from omnid.config import load_config
from omnid.diagnostics.run_statistics import RunCounters, RunStatistics
from omnid.diagnostics.run_summary import run_summary
from omnid.engine.graph import Graph
from omnid.runs.pipeline import Sinks, wire
from omnid.sinks.files import MapFile, TrajectoryFile
from omnid.stages.front_end import FrontEnd
from omnid.stages.geometry import geometry, with_rims
from omnid.stages.synchronise import Synchronise
from tests.benchmark.results import Column, ResultTable
from tests.replay.test_memory import to_and_fro

TWO_WALLS = Path(__file__).parents[3] / "shared" / "data" / "two_walls"
PAIRS = 300
PROFILE = os.environ.get("OMNID_BENCHMARK_PROFILE", "")
WANTED_HZ = 20.0


def recording() -> tuple[LogReader, Rig]:
    """Return images of 768x768 if they are available, else those of the sample, 512x512."""
    if TWO_WALLS.is_dir():
        return LogReader(TWO_WALLS / "log.mcap"), import_kalibr(TWO_WALLS / "camchain.yaml")
    reader = LogReader(Path(str(files("omnid.sample") / "log.mcap")))
    return reader, parse_rig(reader.attachments()["rig.toml"])


@pytest.mark.benchmark
@pytest.mark.parametrize("hz", [10, 30])
@pytest.mark.parametrize("threaded", [True, False], ids=["threaded", "inline"])
def test_pairs_per_second(tmp_path: Path, threaded: bool, hz: int) -> None:
    """hz: pairs a second by their stamps; the map takes at most 5 of them."""
    reader, rig = recording()
    config = load_config(None, PROFILES[PROFILE] if PROFILE else ())
    frames, statistics = list(reader.frames()), RunStatistics()
    cv2.setNumThreads(config.graph.opencv_threads)
    place = geometry(with_rims(rig, frames), config.panorama)
    graph = Graph(threaded=threaded)
    sinks = Sinks(
        {"statistics": statistics, "trajectory": TrajectoryFile(tmp_path / "t")}, {"map": MapFile(tmp_path / "m")}
    )
    read = graph.source("read", lambda: to_and_fro(frames, PAIRS, round(1e9 / hz)))
    wire(graph, graph.stage("pair", Synchronise(place.rig, config.pair), read), FrontEnd(place, config), config, sinks)
    started_s = time.perf_counter()
    graph.run()
    rate_hz = PAIRS / (time.perf_counter() - started_s)
    summary = run_summary(RunCounters.of(statistics, PAIRS, {}), graph.telemetry.summary(), verbose=True)
    columns = (Column("run"), Column("pairs/s", "", 1))
    table = ResultTable("speed", "speed", "Pairs per second of the whole pipeline", columns, continued=True)
    table.add(f"{hz} Hz by the stamps, {'threaded' if threaded else 'inline'}, profile {PROFILE or 'none'}", rate_hz)
    print(summary)
    assert not threaded or rate_hz >= WANTED_HZ
