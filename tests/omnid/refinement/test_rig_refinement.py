"""Refinement of the rig in a run: a disturbed rig is reported with sigmas, a right one is not; bounded and ended."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from calib.models.unified import UnifiedCamera
from calib.rig import MountedCamera, Rig
from calib.rig_file import read_rig
from drivers.logs.log_reader import LogReader
from omnid.config import Config, PanoramaConfig, RigConfig
from omnid.engine.graph import Graph
from omnid.messages import OdometryUpdate
from omnid.refinement.rig_refinement import RigRefinement
from omnid.stages.dewarp import Dewarp
from omnid.stages.geometry import geometry
from omnid.stages.odometry import OdometryStage
from omnid.stages.rig_gate import RigGate
from omnid.stages.stereo import Stereo
from omnid.stages.synchronise import Synchronise
from omnid.transport.status_names import RIG_REFINEMENT
from tests.simulation import build, write_log

SETTINGS = RigConfig(refine_keyframes=16)


@pytest.fixture(scope="module")
def rooms(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Write the log of a round through a room, with 32 pairs."""
    folder = tmp_path_factory.mktemp("rooms")
    run = build("rooms", seed=33, size=320, pairs=32)
    write_log(folder, run.rig, run.poses, run.scene, sensor=run.sensor, seed=33)
    return folder


def shifted(mounted: MountedCamera, sign: float) -> MountedCamera:
    """Return the camera with its centre half a pixel and its focal length half a per cent off."""
    camera = mounted.camera
    assert isinstance(camera, UnifiedCamera)
    focal = camera.focal[0] * (1 + sign * 5e-3), camera.focal[1] * (1 + sign * 5e-3)
    centre = camera.center[0] + 0.5 * sign, camera.center[1] - 0.5
    return replace(mounted, camera=replace(camera, center=centre, focal=focal))


def refined(folder: Path, rig: Rig, settings: RigConfig = SETTINGS) -> tuple[RigRefinement, list[OdometryUpdate]]:
    """Run a log through the stages; return the refinement and the poses."""
    place, config, graph = geometry(rig, PanoramaConfig()), Config(), Graph(threaded=False)
    refinement, kept = RigRefinement(place, settings), list[OdometryUpdate]()

    class Collector:
        def process(self, update: OdometryUpdate) -> None:
            kept.append(update)

    frames = graph.source("log", LogReader(folder / "log.mcap").frames)
    pairs = graph.stage("pair", Synchronise(rig, config.pair), frames)
    panoramas = graph.stage("dewarp", Dewarp(place, config.panorama), pairs)
    depth = graph.stage("stereo", Stereo(place, config.stereo, RigGate(place.cylinder, "off")), panoramas)
    poses = graph.stage("odometry", OdometryStage(place, config.odometry), depth)
    graph.sink("refine", refinement, poses)
    graph.sink("kept", Collector(), poses)
    graph.run()
    return refinement, kept


def test_a_disturbed_rig_is_reported_with_its_sigmas(rooms: Path) -> None:
    truth = read_rig(rooms / "rig.toml")
    wrong = replace(truth, lower=shifted(truth.lower, 1.0), upper=shifted(truth.upper, -1.0))
    refinement, _ = refined(rooms, wrong)
    status = refinement.status()
    assert (status.name, status.level) == (RIG_REFINEMENT, 1) and "omnid calibrate drive" in status.message
    assert refinement.found is not None and refinement.found.is_significant
    assert float(status.values["refined_error_px"]) < 0.5 * float(status.values["error_px"])
    assert abs(float(status.values["lengths_percent"])) > 4 * float(status.values["lengths_sigma_percent"]) > 0
    before, after = (float(status.values[f"lower_pu_{when}"]) for when in ("before", "after"))
    assert 0.2 < before - after < 0.7 and 0 < float(status.values["lower_pu_sigma"]) < 0.1
    assert status.values["windows"] == "1" and status.values["windows_without_result"] == "0"


def test_a_right_rig_is_not_reported(rooms: Path) -> None:
    refinement, poses = refined(rooms, read_rig(rooms / "rig.toml"))
    status = refinement.status()
    assert (status.level, status.message) == (0, "the rig fits the landmarks of this run")
    assert abs(float(status.values["lengths_percent"])) < 0.5 and "lower_pu_after" not in status.values
    waiting = RigRefinement(geometry(read_rig(rooms / "rig.toml"), PanoramaConfig()), SETTINGS, lambda: False)
    for update in poses[:3]:
        waiting.process(update)
    assert waiting.status().values["keyframes"] == "0", "no keyframe under overload"


def test_a_gap_begins_a_new_window_and_a_running_estimate_is_ended(rooms: Path) -> None:
    rig = read_rig(rooms / "rig.toml")
    refinement, poses = refined(rooms, rig, RigConfig(refine_keyframes=80))
    assert refinement.found is None and refinement.status().message.startswith("not estimated yet")
    assert int(refinement.status().values["keyframes"]) > 15
    refinement.process(replace(poses[-1], reset_counter=1, T_odom_rig=np.eye(4)))
    assert refinement.status().values["keyframes"] == "1"
    busy = RigRefinement(geometry(rig, PanoramaConfig()), RigConfig(refine_keyframes=15))
    for update in poses:
        busy.process(update)
        if busy._child is not None:
            break
    assert busy._child is not None
    process = busy._child._process
    busy.close()
    assert process.returncode is not None and busy.status().values["windows"] == "0"
