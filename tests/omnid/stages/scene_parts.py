"""Parts of the pipeline on the frames of the rendered scene, for tests of stages and of their wiring."""

from __future__ import annotations

from pathlib import Path

import pytest

from calib.rig_file import read_rig
from drivers.frame import Frame
from drivers.logs.log_reader import LogReader
from omnid.camera_config import PairConfig
from omnid.config import Config
from omnid.messages import FramePair, StereoDepth
from omnid.stages.dewarp import Dewarp
from omnid.stages.front_end import FrontEnd
from omnid.stages.geometry import Geometry, geometry
from omnid.stages.synchronise import Synchronise

CONFIG = Config()


@pytest.fixture(scope="module")
def frames(scene: Path) -> list[Frame]:
    return list(LogReader(scene / "log.mcap").frames())


@pytest.fixture(scope="module")
def rig_geometry(scene: Path) -> Geometry:
    return geometry(read_rig(scene / "rig.toml"), CONFIG.panorama)


def front_end(rig_geometry: Geometry) -> FrontEnd:
    return FrontEnd(rig_geometry, CONFIG)


def run_pairs(rig_geometry: Geometry, frames: list[Frame]) -> tuple[list[FramePair], dict[str, int]]:
    sync = Synchronise(rig_geometry.rig, PairConfig())
    made = [pair for frame in frames if (pair := sync.process(frame)) is not None]
    sync.finish()
    return made, sync.counts


def depth_of(rig_geometry: Geometry, frames: list[Frame]) -> StereoDepth:
    (pair,), _ = run_pairs(rig_geometry, frames[:2])
    return StereoDepth(Dewarp(rig_geometry, CONFIG.panorama).process(pair))
