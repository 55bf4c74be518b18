"""V.B, fig. 8: original SAD against enhanced SAD on a wall of identical bricks, and on one that does not repeat."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from calib import se3
from calib.models.camera import Array
from omnid.config import Config
from omnid.core.stereo.edges import edge_pixels, smooth
from omnid.messages import Panoramas
from omnid.stages.stereo import Stereo
from tests.experiments import figures as images
from tests.experiments.scenes import WALL_M
from tests.experiments.truth import cast
from tests.experiments.views import Experiment, Views, look
from tests.simulation.recipes import Run

METHODS = {"original SAD": "sad", "enhanced SAD": "enhanced", "semi-global (omnid)": "semiglobal"}
WRONG_M = 0.05  # off the wall
HALF_ANGLE_DEG = 45.0  # of the wall that is looked at: farther along it 5 cm are within the noise of depth


def measure(folder: Path, experiment: Experiment) -> dict[str, Any]:
    """For each method: matches on the wall, share of wrong ones, completeness, RMS to the plane [m]."""
    run, views = experiment.run, look(folder)
    return {label: _judge([_on_wall(run, views, method, n) for n in range(len(views.panoramas))])
            for label, method in METHODS.items()}


def _judge(errors_and_edges: list[tuple[Array, int]]) -> dict[str, float]:
    errors = np.concatenate([errors for errors, _ in errors_and_edges])
    edges = sum(count for _, count in errors_and_edges)
    right = np.abs(errors) <= WRONG_M
    return {"matches": len(errors), "wrong": float(1 - right.mean()), "completeness": float(right.sum() / edges),
            "rms_m": float(np.sqrt(np.mean(errors**2))), "rms_of_right_m": float(np.sqrt(np.mean(errors[right] ** 2)))}


def _on_wall(run: Run, views: Views, method: str, pair: int) -> tuple[Array, int]:
    """Distances (N,) [m] behind the wall's plane of one pair's matches on it, and how many edges there are on it."""
    panoramas, T_world_rig = views.panoramas[pair], run.poses[pair]
    depth = stereo(views, method).process(panoramas)
    points = se3.apply(T_world_rig, depth.points)
    seen = _is_wall(run, views, T_world_rig, depth.pixels)
    edges = _edges(panoramas)
    return points[seen, 0] - WALL_M, int(_is_wall(run, views, T_world_rig, edges).sum())


def stereo(views: Views, method: str) -> Stereo:
    """omnid's stage with one of the methods."""
    config = Config().stereo
    return Stereo(views.place, replace(config, matching=replace(config.matching, method=method)))


def _edges(panoramas: Panoramas) -> Array:
    """Pixels (N, 2) of the lower panorama that every method tries to match."""
    matching = Config().stereo.matching
    image = smooth(panoramas.lower.panorama, matching.sigma_px)
    flat = edge_pixels(image, panoramas.visible, matching.edge_threshold, matching.max_points)
    rows, columns = np.divmod(flat, image.shape[1])
    return np.column_stack([columns, rows]).astype(float)


def _is_wall(run: Run, views: Views, T_world_rig: Array, pixels: Array) -> Array:
    """Which pixels (N, 2) truly show the wall, within HALF_ANGLE_DEG of straight ahead."""
    rays = views.rays(pixels) @ T_world_rig[:3, :3].T
    _, which = cast(run.scene, views.viewpoint(T_world_rig), rays)
    walls = [number for number, r in enumerate(run.scene.rectangles) if r.name == "wall"]
    ahead = np.abs(np.arctan2(rays[:, 1], rays[:, 0])) <= np.deg2rad(HALF_ANGLE_DEG)
    return np.asarray(np.isin(which, walls) & ahead)


def draw(folder: Path, experiment: Experiment, path: Path) -> None:
    """The points of the middle pair by every method."""
    run, views = experiment.run, look(folder)
    pair = len(views.panoramas) // 2
    images.wall({name: _cloud(run, views, method, pair) for name, method in METHODS.items()}, WALL_M, path)


def _cloud(run: Run, views: Views, method: str, pair: int) -> Array:
    """Points (N, 3) of the wall, as located, in the world."""
    depth = stereo(views, method).process(views.panoramas[pair])
    return se3.apply(run.poses[pair], depth.points[_is_wall(run, views, run.poses[pair], depth.pixels)])
