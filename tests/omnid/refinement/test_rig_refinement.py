"""Refinement of the rig in a run: a disturbed rig is reported with sigmas, a right one is not; bounded and ended."""

from __future__ import annotations

from contextlib import closing
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from calib import se3
from calib.fit.drive_problem import DriveObservations, DriveState, KeyframeMotion, project
from calib.models.unified import UnifiedCamera
from calib.rig import MountedCamera, Rig
from calib.rig_file import read_rig, write_rig
from drivers.logs.log_reader import LogReader
from omnid.calibration.drive_observations import tracked_updates
from omnid.config import Config, PanoramaConfig, RigConfig, StereoConfig
from omnid.engine.graph import Graph
from omnid.formats.tum import read_tum
from omnid.messages import OdometryUpdate, StereoDepth
from omnid.refinement.estimate import RefinementRequest, RigChange, estimate
from omnid.refinement.foreign_rig import other_rig
from omnid.refinement.rig_application import MARK, RigApplication
from omnid.refinement.rig_refinement import RigRefinement
from omnid.runs.pipeline import Sinks, wire
from omnid.runs.replay import ReplayOptions, run_log
from omnid.simulation.rendering.ray_caster import render_grey
from omnid.simulation.rendering.rigs import make_rig
from omnid.stages.dewarp import Dewarp
from omnid.stages.geometry import GeometryVersions, geometry
from omnid.stages.odometry import OdometryStage
from omnid.stages.rig_gate import RigContradictedError, RigGate
from omnid.stages.stereo import Stereo
from omnid.stages.synchronise import Synchronise
from omnid.transport.codec import DiagnosticStatus
from omnid.transport.status_names import RIG_REFINEMENT
from tests.simulation import build
from tests.simulation.logs import pack_log
from tests.simulation.paths import loop

Array = NDArray[np.float64]
SETTINGS = RigConfig(refine_keyframes=16)


PAIRS, STAND = 32, 24


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


@pytest.fixture(scope="module")
def stop_and_go(room: RenderedRoom, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Write a log of a round, of a stand at its end, and of the beginning of a second round."""
    numbers = np.concatenate([np.arange(PAIRS), np.full(STAND, PAIRS - 1), np.arange(12)])
    return room.write(tmp_path_factory.mktemp("stop_and_go"), numbers)


class Patient:
    """A sink that waits for each estimate, as a run in real time does by itself."""

    def __init__(self, refinement: RigRefinement) -> None:
        self.refinement, self.poses, self.statuses = refinement, list[OdometryUpdate](), list[DiagnosticStatus]()

    def process(self, update: OdometryUpdate) -> None:
        """Take a pose."""
        self.refinement.process(update)
        if self.refinement._child is not None:
            self.refinement._child.wait()
        self.poses.append(replace(update, depth=StereoDepth(update.depth.panoramas, update.depth._compute)))
        self.statuses.append(self.refinement.status())


def applied(folder: Path, rig: Rig, path: Path | None) -> tuple[Patient, GeometryVersions, list[Rig]]:
    """Run a log with a rig that is refined and applied."""
    place, graph = geometry(rig, PanoramaConfig()), Graph(threaded=False)
    config = Config(stereo=StereoConfig(rig_check="off"))
    versions, published, lines = GeometryVersions(place), list[Rig](), list[str]()
    application = RigApplication(versions, path, published.append, lines.append)
    settings = RigConfig(refine="apply", refine_keyframes=16, refine_s=1e5)
    sink = Patient(RigRefinement(versions, settings, apply=application))
    frames = graph.source("log", LogReader(folder / "log.mcap").frames)
    pairs = graph.stage("pair", Synchronise(rig, config.pair), frames)
    wire(graph, pairs, place, config, Sinks(poses={"refine": sink}, versions=versions))
    graph.run()
    assert len(lines) == len(published)
    return sink, versions, published


def test_a_disturbed_rig_is_replaced_at_the_first_stand(stop_and_go: Path, tmp_path: Path) -> None:
    truth = read_rig(stop_and_go / "rig.toml")
    lower, upper = (shifted(side, sign, 0.3, 1e-3) for side, sign in ((truth.lower, 1.0), (truth.upper, -1.0)))
    wrong = replace(truth, lower=lower, upper=upper)
    path = tmp_path / "rig.toml"
    write_rig(path, wrong)
    calibration = path.read_bytes()
    sink, versions, published = applied(stop_and_go, read_rig(path), path)
    # 1. Once, while the robot stood; poses go on from where they were.
    assert versions.newest == 1 and len(published) == 1
    number = next(k for k, update in enumerate(sink.poses) if update.depth.panoramas.rig_version == 1)
    assert PAIRS + 19 <= number < PAIRS + STAND
    before, after = sink.poses[number - 1], sink.poses[number]
    assert np.linalg.norm(after.T_odom_rig[:3, 3] - before.T_odom_rig[:3, 3]) < 1e-3
    assert {update.reset_counter for update in sink.poses} == {0}
    assert (np.diag(after.covariance) >= 0.99 * np.diag(before.covariance)).all()
    # 2. Steps afterwards have the right length, those before had not.
    T_world_rig = read_tum(stop_and_go / "truth.txt").T
    errors = [abs(_path_m(np.array([sink.poses[k].T_odom_rig for k in part])) / _path_m(T_world_rig[part]) - 1)
              for part in (np.arange(31), np.arange(number, len(sink.poses)))]
    assert errors[1] < 0.6 * errors[0]
    # 3. Status, and the file with what was there before.
    statuses = [status.message for status in sink.statuses]
    assert any("as soon as the robot stands" in message for message in statuses)
    values = sink.statuses[-1].values
    assert values["applied"] == "1" and values["applied_file"] == str(path) and sink.statuses[-1].level == 0
    assert float(values["applied_lower_pu_before"]) > float(values["applied_lower_pu_after"])
    assert path.read_text().startswith(MARK) and (tmp_path / "rig.original.toml").read_bytes() == calibration
    written = read_rig(path)
    assert written.lower.camera == versions[1].rig.lower.camera and written.covariance is not None


def _path_m(T: Array) -> float:
    return float(np.linalg.norm(np.diff(T[:, :3, 3], axis=0), axis=1).sum())


def test_a_file_that_somebody_changed_is_left_alone(rooms: Path, tmp_path: Path) -> None:
    path, rig = tmp_path / "rig.toml", read_rig(rooms / "rig.toml")
    write_rig(path, rig)
    lines = list[str]()
    application = RigApplication(GeometryVersions(geometry(rig, PanoramaConfig())), path, lambda _: None, lines.append)
    names, zero = ("lower pu", "r_x"), np.zeros(2)
    change = RigChange(rig, names, zero, np.array([0.1, 0.0]), np.full(2, 0.01), 0.01, 1e-3, 0.2, 0.1, 20, 500)
    assert application(change) == str(path) and application(change) == str(path)
    assert (tmp_path / "rig.previous.toml").read_bytes() == path.read_bytes()
    write_rig(path, rig)
    calibration = path.read_bytes()
    assert "was changed" in application(change) and path.read_bytes() == calibration
    assert len(lines) == 3 and "not written" in lines[-1]
    fresh = RigApplication(GeometryVersions(geometry(rig, PanoramaConfig())), tmp_path, lambda _: None, lines.append)
    assert "not written" in fresh(change)


def test_a_large_change_is_not_small(rooms: Path) -> None:
    names, zero, sigmas = ("lower pu", "r_x"), np.zeros(2), np.full(2, 1e-3)
    change = RigChange(read_rig(rooms / "rig.toml"), names, zero, np.array([3.0, 0.01]), sigmas, 0.01, 1e-3, 0.2, 0.1,
                       20, 500)
    assert change.is_significant and change.is_small
    assert not replace(change, lengths=-0.06).is_small and not replace(change, after=np.array([0.0, 0.02])).is_small


@pytest.mark.parametrize("offset_ms", [0.0, 7.0])
def test_a_late_upper_camera_is_found_where_there_is_one(offset_ms: float) -> None:
    """Exact landmarks of a drive with turns, with noise; stamps 5 ms apart, exposures by the offset more."""
    truth, rng, keyframes, landmarks = make_rig(size=512, baseline_m=0.22), np.random.default_rng(4), 14, 140
    T_rig_odom = se3.inverse(se3.inverse(loop(4, keyframes)[0]) @ loop(4, keyframes))
    azimuth, range_m = rng.uniform(-np.pi, np.pi, landmarks), rng.uniform(1.6, 4.0, landmarks)
    points = np.column_stack([range_m * np.cos(azimuth), range_m * np.sin(azimuth), rng.uniform(-1, 1.2, landmarks)])
    keyframe, landmark, camera = (part.ravel() for part in np.mgrid[:keyframes, :landmarks, :2])
    twist = np.column_stack([rng.uniform(-0.6, 0.6, (keyframes, 2)), np.zeros((keyframes, 3)),
                             rng.uniform(-0.7, 0.7, keyframes)])
    late = se3.exp(-(5e-3 + 1e-3 * offset_ms) * twist) @ T_rig_odom
    in_rig = np.where(camera[:, None] == 1, se3.apply(late, points)[keyframe, landmark],
                      se3.apply(T_rig_odom, points)[keyframe, landmark])
    pixels = project(truth, camera, in_rig) + 0.05 * rng.standard_normal((len(keyframe), 2))
    seen = np.isfinite(pixels).all(axis=1)
    state = DriveState(T_rig_odom, points, np.zeros(0), KeyframeMotion(twist, np.full(keyframes, 5e-3)))
    observations = DriveObservations(keyframe[seen], landmark[seen], camera[seen], pixels[seen])
    change = estimate(RefinementRequest(truth, state, observations, has_delay=True))
    assert change.delay_ms is not None and not change.has_moved and change.is_small
    before, after, sigma = change.delay_ms
    assert before == 0 and abs(after - offset_ms) < max(5 * sigma, 0.1) and 0 < sigma < 0.2
    assert change.has_delay is change.is_significant is (offset_ms > 0)
    assert change.rig.times.upper_delay_s == pytest.approx(1e-3 * offset_ms, abs=3e-4 if offset_ms else 0.0)
    assert change.rig.lower == truth.lower, "the geometry stays where only the delay has changed"
    assert estimate(RefinementRequest(truth, state, observations)).delay_ms is None


def test_another_mirror_is_no_rig_of_a_log_and_a_replay_writes_nothing(rooms: Path, tmp_path: Path) -> None:
    right = read_rig(rooms / "rig.toml")
    other = replace(right, lower=other_mirror(right.lower), upper=other_mirror(right.upper))
    write_rig(tmp_path / "other.toml", other)
    options = ReplayOptions(rig=tmp_path / "other.toml", tum=tmp_path / "a.tum", record=tmp_path / "a.mcap")
    with pytest.raises(RigContradictedError, match=r"xi would change from 0.75 to .*rig_check=warn"):
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
    place = geometry(rig, config.panorama)
    with closing(LogReader(rooms / "log.mcap")) as reader:
        assert other_rig(tracked_updates(reader, place, config, rooms), place) == ""
