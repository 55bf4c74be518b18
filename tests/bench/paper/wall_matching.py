"""V.B, fig. 8: SAD, enhanced SAD and omnid's matching on a wall of identical bricks, a control and a smooth wall."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from calib import se3
from calib.models.camera import Array
from omnid.config import Config
from omnid.core.stereo.matcher import edge_pixels, smooth
from omnid.messages import Panoramas
from omnid.stages.dense_depths import DenseStereo
from omnid.stages.geometry import Geometry
from tests.bench.paper.scenes import WALL_M
from tests.bench.paper.truth import cast
from tests.bench.paper.views import Experiment, Views, load_views
from tests.simulation.recipes import SimulatedRun

SAD_METHODS = {"original SAD": "sad", "enhanced SAD": "enhanced", "semi-global (omnid)": "semiglobal"}
WRONG_M = 0.05  # largest distance of a right point from the wall
MISMATCHED_M = 0.2  # a point farther off is not only located inexactly
HALF_ANGLE_DEG = 45.0  # from straight ahead; farther along the wall, 5 cm are within the noise of the depth
CELL_M = 0.1  # side of the squares of the wall of which the covered ones are counted
Matching = Callable[[Panoramas], tuple[Array, Array]]  # pixels (N, 2) of the lower panorama, points (N, 3) in the rig


@dataclass(frozen=True, slots=True)
class WallMatches:
    """Matches of one pair that truly lie on the wall."""

    points: Array  # (N, 3) m in the world, as located
    spots: Array  # (N, 2) m, where they truly are on the wall: to the left of the rig, and height
    edges: int  # edge pixels on the wall: what every SAD method tries to match


def measure(folder: Path, experiment: Experiment) -> dict[str, Any]:
    """Return for each method: matches on the wall, share of wrong ones, completeness, coverage, RMS to the plane."""
    run, views = experiment.run, load_views(folder)
    values = {}
    for name, method in SAD_METHODS.items():
        matching = partial(_located, stereo(views.geometry, method))
        values[name] = _errors(run, [_on_wall(run, views, matching, pair) for pair in range(len(views.panoramas))])
    return values


def stereo(place: Geometry, method: str) -> DenseStereo:
    """Return omnid's dense stereo with one of its methods."""
    config = Config().stereo
    return DenseStereo(place, replace(config, matching=replace(config.matching, method=method)))


def _located(dense: DenseStereo, panoramas: Panoramas) -> tuple[Array, Array]:
    depth = dense.compute(panoramas)
    return depth.pixels, depth.points


def _on_wall(run: SimulatedRun, views: Views, matching: Matching, pair: int) -> WallMatches:
    """Return one pair's matches whose pixels truly show the wall."""
    panoramas, T_world_rig = views.panoramas[pair], run.poses[pair]
    pixels, points = matching(panoramas)
    on_wall, true_points = _wall_points(run, views, T_world_rig, pixels)
    edges, _ = _wall_points(run, views, T_world_rig, _edges(panoramas))
    spots = true_points[on_wall, 1:] - [T_world_rig[1, 3], 0.0]
    return WallMatches(se3.apply(T_world_rig, points)[on_wall], spots, int(edges.sum()))


def _wall_points(run: SimulatedRun, views: Views, T_world_rig: Array, pixels: Array) -> tuple[Array, Array]:
    """Return which pixels (N, 2) show the wall within HALF_ANGLE_DEG of straight ahead, and their points (N, 3)."""
    rays = views.rays(pixels) @ T_world_rig[:3, :3].T
    origin = views.viewpoint(T_world_rig)
    distance, which = cast(run.scene, origin, rays)
    walls = [number for number, r in enumerate(run.scene.rectangles) if r.name == "wall"]
    ahead = np.abs(np.arctan2(rays[:, 1], rays[:, 0])) <= np.deg2rad(HALF_ANGLE_DEG)
    return np.isin(which, walls) & ahead, origin + np.where(np.isfinite(distance), distance, 0)[:, None] * rays


def _edges(panoramas: Panoramas) -> Array:
    """Return the pixels (N, 2) of the lower panorama that every SAD method tries to match."""
    matching = Config().stereo.matching
    image = smooth(panoramas.lower.panorama, matching.sigma_px)
    flat = edge_pixels(image, panoramas.visible, matching.edge_threshold, matching.max_points)
    rows, columns = np.divmod(flat, image.shape[1])
    return np.column_stack([columns, rows]).astype(float)


def _errors(run: SimulatedRun, pairs: list[WallMatches]) -> dict[str, float]:
    """Return the errors over all pairs; completeness: right matches as a share of the edge pixels."""
    error_m = np.concatenate([p.points[:, 0] for p in pairs]) - WALL_M
    right = np.abs(error_m) <= WRONG_M
    return {
        "matches": len(error_m) / len(pairs),
        "wrong": float((~right).mean()),
        "mismatched": float((np.abs(error_m) > MISMATCHED_M).mean()),
        "completeness": float(right.sum() / sum(pair.edges for pair in pairs)),
        "coverage": _coverage(run, pairs),
        "rms_of_right_m": float(np.sqrt(np.mean(error_m[right] ** 2))),
    }


def _coverage(run: SimulatedRun, pairs: list[WallMatches]) -> float:
    """Return the share of the squares of the wall within HALF_ANGLE_DEG that hold a right match, mean of the pairs."""
    half_m = WALL_M * np.tan(np.deg2rad(HALF_ANGLE_DEG))
    wall = next(r for r in run.scene.rectangles if r.name == "wall")
    squares = round(2 * half_m / CELL_M) * round(wall.height_m / CELL_M)
    shares = []
    for pair in pairs:
        right = np.abs(pair.points[:, 0] - WALL_M) <= WRONG_M
        cells = np.unique(np.floor(pair.spots[right] / CELL_M), axis=0)
        shares.append(len(cells) / squares)
    return float(np.mean(shares))
