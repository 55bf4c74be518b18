"""Tests of the scenes (seeded, closed, clear of walls) and of POV-Ray's images against the camera models."""

from __future__ import annotations

from functools import cache
from pathlib import Path

import cv2
import numpy as np
import pytest

from calib import se3
from omnid.simulation.rendering.ray_caster import render_grey
from omnid.simulation.rendering.rigs import make_rig
from tests.bench.paper.povray import INSTALL, PovrayError, available, shoot, view_text, write_world
from tests.bench.paper.scenes import EXPERIMENTS, build
from tests.bench.paper.truth import cast, sees, surface_distance_m
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
