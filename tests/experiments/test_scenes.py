"""Tests of the scenes (seeded, closed, clear of walls) and of POV-Ray's images against the camera models."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from pathlib import Path

import cv2
import numpy as np
import pytest

from calib import se3
from calib.rig_file import read_rig
from drivers.frame import gray
from drivers.logs.log_reader import LogReader
from omnid.simulation.lockstep import with_masks
from omnid.simulation.rendering.ray_caster import render_grey
from omnid.simulation.rendering.rigs import make_rig
from omnid.simulation.robot import make_robot
from tests.experiments.building import building
from tests.experiments.obstacle_posterior.scenes import base_pose, obstacle_scene, render_pair
from tests.experiments.obstacle_posterior.traced import TracedScene
from tests.experiments.povray import INSTALL, PovrayError, available, shoot, view_text, write_world
from tests.experiments.rendering import cast_log, render_log
from tests.experiments.scenes import EXPERIMENTS, RigOptions, build
from tests.experiments.truth import cast, sees, surface_distance_m
from tests.experiments.views import Experiment
from tests.simulation import SimulatedRun, corridor

needs_povray = pytest.mark.skipif(not available(), reason=f"POV-Ray is not installed: {INSTALL}")
MISALIGNED = (1.0, -2.0, 20.0)


@cache
def _built(name: str, seed: int) -> SimulatedRun:
    """Return the run of a name and a seed: a building takes a second."""
    return build(name, seed, 96)


@pytest.mark.parametrize("name", EXPERIMENTS)
def test_a_seed_determines_the_run(name: str) -> None:
    one, other = _built(name, 3), _built(name, 4)
    corridor.cache_clear()
    again = build(name, 3, 96)
    np.testing.assert_array_equal(one.poses, again.poses)
    walls, same, others = (run.scene.rectangles for run in (one, again, other))
    assert all((a.texture == b.texture).all() for a, b in zip(walls, same, strict=True))
    assert not all(np.array_equal(a.texture, b.texture) for a, b in zip(walls, others, strict=False))


@pytest.mark.parametrize("seed", [3, 4])
def test_the_round_through_the_building_closes_and_keeps_its_distance_from_walls(seed: int) -> None:
    run = _built("building", seed)
    steps = np.linalg.norm(np.diff(run.poses[:, :3, 3], axis=0), axis=1)
    heading = np.unwrap([float(se3.yaw(T)) for T in run.poses])
    assert len(run.poses) == 349 and 25 < steps.sum() < 40
    np.testing.assert_allclose(run.poses[0], run.poses[-1], atol=1e-9)
    assert heading[-1] - heading[0] == pytest.approx(2 * np.pi)
    assert steps.max() > 2 * steps.min()
    assert surface_distance_m(run.scene, run.poses[:, :3, 3]).min() > 0.35


def test_a_door_of_a_room_shows_the_corridor_and_its_walls_are_closed() -> None:
    plan, scene = building(2)
    middle = np.array([(plan.columns[0] + plan.columns[1]) / 2, (plan.corridor_m + plan.middle_m) / 2, 1.5])
    azimuth = np.linspace(-np.pi, np.pi, 720, endpoint=False)
    distance, which = cast(scene, middle, np.column_stack([np.cos(azimuth), np.sin(azimuth), 0 * azimuth]))
    outer = np.isin(which, range(4))
    assert np.isfinite(distance).all() and 0.02 < outer.mean() < 0.3
    assert (np.sin(azimuth[outer]) < 0).all()  # the door of a lower row leads to the lower corridor


def test_rays_hit_the_surfaces_that_visibility_is_checked_against() -> None:
    run = build("two_walls", 3, 96, 4)
    T_world_rig = run.poses[2]
    points = T_world_rig[:3, 3] + np.array([[0.3, 0.2, 0.1], [0.1, -0.3, -0.2]])
    distance, which = cast(run.scene, T_world_rig[:3, 3], points - T_world_rig[:3, 3])
    hits = T_world_rig[:3, 3] + distance[:, None] * (points - T_world_rig[:3, 3])
    assert (surface_distance_m(run.scene, hits) < 1e-9).all() and (which >= 0).all()
    assert sees(run.scene, T_world_rig[:3, 3], hits).all()
    assert not sees(run.scene, T_world_rig[:3, 3], hits + 0.1 * (points - T_world_rig[:3, 3])).any()


def test_a_camera_that_no_mirror_realises_is_refused() -> None:
    for rig in (make_rig(size=96, distortion=(0.1, 0, 0, 0)), make_rig(size=96, xi=1.2)):
        with pytest.raises(PovrayError, match="xi <= 1 and no distortion"):
            view_text(rig.lower, np.eye(4))


def test_the_ray_caster_writes_the_same_files(tmp_path: Path) -> None:
    experiment = Experiment("smooth", 3, 96, 2, RigOptions(baseline_m=0.3), "ray_caster")
    experiment.write(tmp_path)
    cast_log(tmp_path, experiment.run, 3, supersample=1)
    assert Experiment.read(tmp_path) == experiment and experiment.label == "smooth_s3_ray_caster"
    assert {"log.mcap", "truth.txt", "rig.toml", "camchain.yaml"} <= {path.name for path in tmp_path.iterdir()}


def test_the_smooth_wall_has_contrast_and_no_edges() -> None:
    front = _built("smooth", 3).scene.rectangles[0]
    steps = np.abs(np.diff(front.texture.astype(int), axis=0))
    assert front.name == "wall" and front.texture.std() > 20 and np.percentile(steps, 99) < 6


@needs_povray
@pytest.mark.parametrize(("xi", "rim"), [(1.0, 0.48), (0.9, 0.45), (0.7, 0.42)])
def test_a_ray_traced_mirror_agrees_with_the_camera_model(xi: float, rim: float, tmp_path: Path) -> None:
    """Compare two independent renderers, for a misaligned camera with an optical centre off the middle."""
    run = build("control", 3, 192, 1)
    rig = make_rig(size=192, xi=xi, rim=rim, misaligned_deg=MISALIGNED, centre_px=(2.3, -3.4))
    write_world(tmp_path, run.scene)
    traced = shoot(tmp_path, rig.upper, run.poses[0], 3)
    model = render_grey(run.scene, rig.upper, run.poses[0], 3)
    both = cv2.erode(((traced > 0) & (model > 0)).astype(np.uint8), np.ones((21, 21), np.uint8)) > 0
    start = np.zeros((192, 192, 2), np.float32)
    images = (traced.astype(np.uint8), model.astype(np.uint8))
    flow = cv2.calcOpticalFlowFarneback(*images, start, 0.5, 3, 21, 3, 7, 1.5, 0)
    assert both.mean() > 0.2
    assert np.median(np.abs(flow[both])) < 0.03 and np.abs(flow[both].mean(axis=0)).max() < 0.02
    assert np.corrcoef(traced[both], model[both])[0, 1] > 0.97
    assert (traced[~rig.upper.visible.contains(_grid(192)).reshape(192, 192)] == 0).mean() > 0.98


def _grid(size: int) -> np.ndarray:
    v, u = np.divmod(np.arange(size * size), size)
    return np.column_stack([u, v]).astype(float)


@needs_povray
def test_rendering_continues_an_interrupted_run_and_writes_a_log_with_its_truth(tmp_path: Path) -> None:
    experiment = Experiment("control", 3, 96, 2, RigOptions(baseline_m=0.3))
    frames = tmp_path / "frames"
    frames.mkdir(parents=True)
    black = np.zeros((96, 96), np.uint16)
    cv2.imwrite(str(frames / "0001_upper.png"), black)  # an existing image is not rendered again
    render_log(tmp_path, experiment.run, 3, supersample=1)
    reader = LogReader(tmp_path / "log.mcap")
    brightness = [gray(frame).mean() for frame in reader.frames()]
    reader.close()
    assert len(brightness) == 4 and sum(mean < 12 for mean in brightness) == 1
    assert read_rig(tmp_path / "rig.toml").baseline_m == pytest.approx(0.3, abs=1e-3)
    assert len((tmp_path / "truth.txt").read_text().splitlines()) == 2
    assert sorted(path.name for path in tmp_path.iterdir() if path.is_dir()) == []
    before = (tmp_path / "log.mcap").stat().st_mtime_ns
    render_log(tmp_path, experiment.run, 3)
    assert (tmp_path / "log.mcap").stat().st_mtime_ns == before


@needs_povray
def test_a_floor_mirrors_the_same_in_both_renderers(tmp_path: Path) -> None:
    scene = obstacle_scene("glossy", 1)
    robot = make_robot(192)
    robot = replace(robot, rig=with_masks(robot.rig))
    cast_glossy = render_pair(scene, robot, base_pose(0.0, 0.0, 0.0), 3)
    cast_matt = render_pair(replace(scene, gloss=0.0), robot, base_pose(0.0, 0.0, 0.0), 3)
    traced = TracedScene(tmp_path, scene, robot).pair(base_pose(0.0, 0.0, 0.0))
    for glossy, matt, image in zip(cast_glossy, cast_matt, traced, strict=True):
        on_floor = np.abs(glossy - matt) > 8
        error, without = (np.median(np.abs(image - other)[on_floor]) for other in (glossy, matt))
        assert on_floor.sum() > 1000 and error < without / 4
