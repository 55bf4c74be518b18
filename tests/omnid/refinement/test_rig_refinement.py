"""Refinement of the rig in a run: a disturbed rig is reported with sigmas, a right one is not; bounded and ended."""

from __future__ import annotations

import tempfile
from collections.abc import Callable
from contextlib import closing
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from calib.models.unified import UnifiedCamera
from calib.refined_rig import read_refined_rig
from calib.rig import MountedCamera, Rig
from calib.rig_file import read_rig, write_rig
from drivers.logs.log_reader import LogReader
from omnid.calibration.drive_observations import tracked_updates
from omnid.config import Config, PanoramaConfig, RigConfig
from omnid.core.rig.rig_health import RigContradictedError, RigHealth
from omnid.engine.graph import Graph
from omnid.formats.tum import read_tum
from omnid.messages import OdometryUpdate
from omnid.refinement.other_rig import other_rig
from omnid.refinement.refined_file import RefinedRigFile
from omnid.refinement.rig_refinement import RigRefinement, ignore
from omnid.runs.replay import ReplayOptions, run_log
from omnid.simulation.rendering.ray_caster import render_grey
from omnid.stages.front_end import FrontEnd
from omnid.stages.geometry import geometry
from omnid.stages.synchronise import Synchronise
from tests.simulation import build
from tests.simulation.logs import pack_log

Array = NDArray[np.float64]
SETTINGS = RigConfig(refine_keyframes=16)


PAIRS = 32


class RenderedRoom:
    """A round through a room, of which each image is rendered once."""

    def __init__(self) -> None:
        self._run = build("rooms", seed=33, size=320, pairs=PAIRS)
        self._images: dict[tuple[int, int], NDArray[np.float32]] = {}

    def write(self, folder: Path, numbers: NDArray[np.intp]) -> Path:
        """Write a log of the poses of these numbers."""
        run = self._run

        def image(pair: int, camera: int) -> NDArray[np.float32]:
            key = int(numbers[pair]), camera
            if key not in self._images:
                self._images[key] = render_grey(run.scene, (run.rig.lower, run.rig.upper)[camera], run.poses[key[0]], 2)
            return self._images[key]

        pack_log(folder, run.rig, run.poses[numbers], image, sensor=run.sensor, seed=33)
        return folder


@pytest.fixture(scope="module")
def room() -> RenderedRoom:
    """Return the room."""
    return RenderedRoom()


@pytest.fixture(scope="module")
def rooms(room: RenderedRoom, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Write the log of a round through a room, with 32 pairs."""
    return room.write(tmp_path_factory.mktemp("rooms"), np.arange(PAIRS))


def shifted(mounted: MountedCamera, sign: float, off_px: float = 0.5, off_part: float = 5e-3) -> MountedCamera:
    """Return the camera with its centre some pixels and its focal length some parts off."""
    camera = mounted.camera
    assert isinstance(camera, UnifiedCamera)
    focal = camera.focal[0] * (1 + sign * off_part), camera.focal[1] * (1 + sign * off_part)
    centre = camera.center[0] + off_px * sign, camera.center[1] - off_px
    return replace(mounted, camera=replace(camera, center=centre, focal=focal))


def refined(
    folder: Path,
    rig: Rig,
    settings: RigConfig = SETTINGS,
    file: RefinedRigFile | None = None,
    report: Callable[[str], None] = ignore,
) -> tuple[RigRefinement, list[OdometryUpdate]]:
    """Run a log through the stages; return the refinement and the poses."""
    place, config, graph = geometry(rig, PanoramaConfig()), Config(), Graph(threaded=False)
    front_end = FrontEnd(place, config, RigHealth(place.cylinder, "off"))
    refinement, kept = RigRefinement(front_end, settings, file=file, report=report), list[OdometryUpdate]()

    class Collector:
        def process(self, update: OdometryUpdate) -> None:
            kept.append(update)

    frames = graph.source("log", LogReader(folder / "log.mcap").frames)
    pairs = graph.stage("pair", Synchronise(rig, config.pair), frames)
    poses = graph.stage("odometry", front_end.poses, graph.stage("dewarp", front_end.dewarp, pairs))
    graph.sink("refine", refinement, poses)
    graph.sink("kept", Collector(), poses)
    graph.run()
    return refinement, kept


def test_a_disturbed_rig_is_reported_with_its_sigmas(rooms: Path) -> None:
    truth = read_rig(rooms / "rig.toml")
    wrong = replace(truth, lower=shifted(truth.lower, 1.0), upper=shifted(truth.upper, -1.0))
    refinement, _ = refined(rooms, wrong)
    status = refinement.report()
    assert status.level == 1 and "omnid calibrate drive" in status.message
    assert refinement.found is not None and refinement.found.is_significant
    assert float(status.values["refined_error_px"]) < 0.5 * float(status.values["error_px"])
    assert abs(float(status.values["lengths_percent"])) > 4 * float(status.values["lengths_sigma_percent"]) > 0
    before, after = (float(status.values[f"lower_pu_{when}"]) for when in ("before", "after"))
    assert 0.2 < before - after < 0.7 and 0 < float(status.values["lower_pu_sigma"]) < 0.1
    assert status.values["windows"] == "1" and status.values["windows_without_result"] == "0"


def test_a_right_rig_is_not_reported(rooms: Path) -> None:
    refinement, poses = refined(rooms, read_rig(rooms / "rig.toml"))
    status = refinement.report()
    assert status.level == 0 and float(status.values["error_px"]) > 0
    assert abs(float(status.values["lengths_percent"])) < 0.5 and "lower_pu_after" not in status.values
    place = geometry(read_rig(rooms / "rig.toml"), PanoramaConfig())
    waiting = RigRefinement(FrontEnd(place, Config()), SETTINGS, lambda: False)
    for update in poses[:3]:
        waiting.process(update)
    assert waiting.report().values["keyframes"] == "0", "no keyframe under overload"


def test_a_gap_begins_a_new_window_and_a_running_estimate_is_ended(rooms: Path) -> None:
    rig = read_rig(rooms / "rig.toml")
    refinement, poses = refined(rooms, rig, RigConfig(refine_keyframes=80))
    assert refinement.found is None and refinement.report().level == 0
    assert int(refinement.report().values["keyframes"]) > 15
    refinement.process(replace(poses[-1], reset_counter=1, T_odom_rig=np.eye(4)))
    assert refinement.report().values["keyframes"] == "1"
    busy = RigRefinement(FrontEnd(geometry(rig, PanoramaConfig()), Config()), RigConfig(refine_keyframes=15))
    for update in poses:
        busy.process(update)
        if busy._child is not None:
            break
    assert busy._child is not None
    process = busy._child._process
    busy.close()
    assert process.returncode is not None and busy.report().values["windows"] == "0"


def test_a_run_goes_on_where_no_estimate_can_be_started(
    rooms: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path / "missing"))
    refinement, poses = refined(rooms, read_rig(rooms / "rig.toml"))
    values = refinement.report().values
    assert values["windows"] == values["windows_without_result"] == "1"
    assert "cannot start" in values["window_problem"] and len(poses) > 15


def disturbed(truth: Rig) -> Rig:
    """Return a rig whose cameras are slightly off."""
    lower, upper = (shifted(side, sign, 0.2, 5e-4) for side, sign in ((truth.lower, 1.0), (truth.upper, -1.0)))
    return replace(truth, lower=lower, upper=upper)


def path_error(poses: list[OdometryUpdate], truth: Path) -> float:
    """Return the relative error of the length of a path."""
    return abs(path_m(np.array([update.T_odom_rig for update in poses])) / path_m(read_tum(truth).T[: len(poses)]) - 1)


def path_m(T: Array) -> float:
    """Return the length of a path [m]."""
    return float(np.linalg.norm(np.diff(T[:, :3, 3], axis=0), axis=1).sum())


def test_a_refined_rig_is_written_and_the_next_start_uses_it(rooms: Path, tmp_path: Path) -> None:
    calibration, path = tmp_path / "rig.toml", tmp_path / "rig.refined.toml"
    write_rig(calibration, disturbed(read_rig(rooms / "rig.toml")))
    content, settings = calibration.read_bytes(), RigConfig(refine="use", refine_keyframes=16, refine_s=1e5)
    # 1. The first run has the calibration to its end, and writes the refined rig.
    file, lines = RefinedRigFile(path, read_rig(calibration), calibration), list[str]()
    rig = file.start(lambda _, line: lines.append(line), is_wanted=True)
    first, poses = refined(rooms, rig, settings, file, lines.append)
    assert file.used is None and len(lines) == 1 and f"{path}: refined" in lines[0] and "next start uses" in lines[0]
    values = first.report().values
    assert values["refined_file"] == lines[0] and float(values["lower_pu_before"]) > float(values["lower_pu_after"])
    assert calibration.read_bytes() == content and [each.name for each in sorted(tmp_path.iterdir())] == [
        "rig.refined.toml",
        "rig.toml",
    ]
    # 2. The second one begins with it, and its lengths are better.
    file = RefinedRigFile(path, read_rig(calibration), calibration)
    rig = file.start(lambda _, line: lines.append(line), is_wanted=True)
    assert str(path) in lines[-1] and str(calibration) in lines[-1] and rig.covariance is not None
    second, better = refined(rooms, rig, settings, file, lines.append)
    assert path_error(better, rooms / "truth.txt") < 0.6 * path_error(poses, rooms / "truth.txt")
    assert second.report().level == 0 and len(lines) == 2, "the refined rig fits, and its file stays"
    assert read_refined_rig(path) is not None


def test_another_mirror_is_no_rig_of_a_log_and_a_replay_writes_nothing(rooms: Path, tmp_path: Path) -> None:
    right = read_rig(rooms / "rig.toml")
    other = replace(right, lower=other_mirror(right.lower), upper=other_mirror(right.upper))
    write_rig(tmp_path / "other.toml", other)
    options = ReplayOptions(rig=tmp_path / "other.toml", tum=tmp_path / "a.tum", record=tmp_path / "a.mcap")
    with pytest.raises(RigContradictedError, match=r"xi would change from 0.75 to .*rig.check=warn"):
        run_log(rooms / "log.mcap", Config(), options)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["other.toml"]


def other_mirror(mounted: MountedCamera) -> MountedCamera:
    """Return the camera below a mirror of another shape, about as large in the image."""
    camera = mounted.camera
    assert isinstance(camera, UnifiedCamera)
    return replace(mounted, camera=replace(camera, xi=0.75, focal=(1.2 * camera.focal[0], 1.2 * camera.focal[1])))


@pytest.mark.slow
def test_a_rig_that_can_be_corrected_is_not_refused(rooms: Path) -> None:
    right, config = read_rig(rooms / "rig.toml"), Config()
    rig = replace(right, lower=shifted(right.lower, 1), upper=shifted(right.upper, -1))
    front_end = FrontEnd(geometry(rig, config.panorama), config)
    with closing(LogReader(rooms / "log.mcap")) as reader:
        assert other_rig(tracked_updates(reader, front_end, config, rooms), front_end) == ""
