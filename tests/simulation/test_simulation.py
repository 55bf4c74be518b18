"""Rendered logs: the same seed gives the same bytes; images, stamps, rigs and poses are those that were asked for."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from calib import se3
from calib.models.camera import Mask
from calib.rig import MountedCamera
from omnid.simulation.rendering.surfaces import Rectangle, Scene
from omnid.simulation.world import clearance_m
from tests.simulation import build, corridor, render, write_log
from tests.simulation.hazard_worlds import HAZARDS, trial
from tests.simulation.rigs import MirrorCamera, render_real, with_real_mirrors

SIZE = 96


def write(folder: Path, name: str = "misaligned", seed: int = 4, pairs: int = 3, **options: Any) -> Path:
    run = build(name, seed, SIZE, pairs)
    write_log(folder, run.rig, run.poses, run.scene, sensor=run.sensor, seed=seed, **options)
    return folder


def test_the_same_seed_gives_the_same_bytes(tmp_path: Path) -> None:
    one = write(tmp_path / "a", seed=4) / "log.mcap"
    corridor.cache_clear()
    again, other = (write(tmp_path / n, seed=s) / "log.mcap" for n, s in (("b", 4), ("c", 5)))
    assert one.read_bytes() == again.read_bytes()
    assert one.read_bytes() != other.read_bytes()


# Skew, rolling shutters, real mirrors


@pytest.mark.parametrize("amount", [0.0, 1.0])
def test_every_row_of_a_rolling_shutter_has_its_own_pose(amount: float) -> None:
    run, twist = build("two_walls", 4, SIZE, 3), np.array([2e-3, 1e-3, -5e-4, 4e-4, -3e-4, 2e-3])
    upper = (with_real_mirrors(run.rig, 4, amount) if amount else run.rig).upper
    rolled, still = (render_real(run.scene, upper, run.poses[1], 3, by) for by in (twist, None))
    for row in (0, 20, 48, 90):
        there = render_real(run.scene, upper, run.poses[1] @ se3.exp(row * twist), 3)
        apart, moved = (np.abs(image[row] - there[row]) for image in (rolled, still))
        assert np.percentile(apart, 90) < 2
        assert row == 0 or apart.mean() < 0.2 * moved.mean()


def test_a_rendered_spot_near_a_tilted_camera_equals_the_projection() -> None:
    """At 0.25 m the ray's origin on the mirror moves the image by about a pixel."""
    camera = MirrorCamera(52.0, (95.5, 95.5), (192, 192), tilt_rad=(0.05, -0.03), conic=0.05)
    edge_u, edge_v = np.array([0.012, -0.024, 0.0]), np.array([0.01, 0.005, -0.025])
    spot = Rectangle(np.array([0.2, 0.1, 0.1]) - (edge_u + edge_v) / 2, edge_u, edge_v, np.full((8, 8), 255, np.uint8))
    mounted = MountedCamera(camera, np.eye(4), Mask(camera.center, 0.0, 92.0))
    image = render(Scene((spot,)), mounted, np.eye(4), 4).astype(float)
    rows, columns = np.indices(image.shape)
    centroid = np.array([(columns * image).sum(), (rows * image).sum()]) / image.sum()
    grid = spot.points(np.stack(np.meshgrid(*2 * [np.linspace(0.05, 0.95, 10)]), axis=-1).reshape(-1, 2))
    np.testing.assert_allclose(centroid, camera.project(grid).mean(axis=0), atol=0.1)


ROBOT_M = 0.2, 1.2  # radius and height


@pytest.mark.parametrize("name", [name for name in HAZARDS if not name.startswith("plain_")])
def test_something_is_in_the_way_of_hazards(name: str) -> None:
    asked = trial(name, 1)
    segments = asked.world.obstacles(ROBOT_M[1])
    assert clearance_m(segments, (0.0, 0.0), ROBOT_M[0]) > 0.1
    if name == "steep_ramp":
        assert asked.world.ground.heights_m(asked.way_m) < -0.7
    elif asked.motion == "ahead" and not asked.world.people:
        along = np.arange(0.0, 4.8, 0.05)
        assert min(clearance_m(segments, (x_m, 0.0), ROBOT_M[0]) for x_m in along) < 0.0
