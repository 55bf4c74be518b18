"""V.D, fig. 10: once around a building; the path, the gap at its end, and the map against the true walls."""

from __future__ import annotations

import tempfile
from pathlib import Path
from typing import Any

import numpy as np

from calib import se3
from calib.models.camera import Array
from omnid.core.mapping.voxel_map import MapPoints
from omnid.formats.ply import read_ply
from omnid.formats.tum import Trajectory, read_tum
from tests.benchmark.accuracy import omnid
from tests.experiments import figures as images
from tests.experiments.path_following import PAPER, against_truth
from tests.experiments.truth import sees, surface_distance_m
from tests.experiments.views import Experiment
from tests.simulation.recipes import Run
from tests.simulation.surfaces import Rectangle

METHODS: dict[str, tuple[str, ...]] = {"the paper": PAPER, "omnid": ()}
NEAR_M = 4.0  # of the path: the map is judged there
SEEN_M = 0.1  # a spot of a wall counts as mapped with a point this close
SPOT_M = 0.25  # between the spots
HEIGHT_M = (0.3, 2.2)  # of the spots
OFF_M = (0.05, 0.2)  # errors that are counted


def measure(folder: Path, experiment: Experiment) -> dict[str, Any]:
    """For each method: errors of the path, the gap between end and start, and the map's."""
    run = experiment.run
    return {name: _judge(folder, run, *_follow(folder, options)) for name, options in METHODS.items()}


def _follow(folder: Path, options: tuple[str, ...]) -> tuple[Trajectory, MapPoints]:
    """Path and map of `omnid replay`, in the frame of the first pose."""
    with tempfile.TemporaryDirectory() as work:
        tum, ply = Path(work) / "estimate.txt", Path(work) / "map.ply"
        omnid("replay", folder / "log.mcap", "--rig", folder / "rig.toml", "--tum", tum, "--map", ply, "--quiet",
              *options)
        return read_tum(tum), read_ply(ply)


def _judge(folder: Path, run: Run, estimate: Trajectory, points: MapPoints) -> dict[str, Any]:
    true_end = se3.inverse(run.poses[0]) @ run.poses[-1]
    gap = se3.inverse(true_end) @ se3.inverse(estimate.T[0]) @ estimate.T[-1]
    return against_truth(estimate, folder) | {
        "end_to_start_m": float(np.linalg.norm(gap[:3, 3])), "map": map_errors(run, points)}


def draw(folder: Path, experiment: Experiment, path: Path) -> None:
    """omnid's map and path over the true floor plan."""
    run = experiment.run
    estimate, points = _follow(folder, ())
    in_world = se3.apply(run.poses[0], points.xyz.astype(float))
    paths = {"truth": run.poses[:, :2, 3], "omnid": (run.poses[0] @ estimate.T)[:, :2, 3]}
    images.floor_plan(run, in_world, paths, path)


def map_errors(run: Run, points: MapPoints) -> dict[str, float]:
    """RMS distance [m] of map points near the path from the nearest true surface, and the share of walls mapped."""
    in_world = se3.apply(run.poses[0], points.xyz.astype(float))
    near = _distance_from_path(run, in_world[:, :2]) < NEAR_M
    error = surface_distance_m(run.scene, in_world[near])
    off = {f"off_by_{limit:g}_m": float((error > limit).mean()) for limit in OFF_M}
    return {"points": int(near.sum()), "rms_m": float(np.sqrt((error**2).mean())), "median_m": float(np.median(error)),
            "completeness": _completeness(run, in_world[near]), **off}


def _distance_from_path(run: Run, xy: Array) -> Array:
    """Level distance (N,) [m] from points (N, 2) to the path."""
    path = run.poses[::3, :2, 3]
    return np.asarray(np.sqrt(np.min([((xy - p) ** 2).sum(axis=1) for p in path], axis=0)))


def _completeness(run: Run, points: Array) -> float:
    """Share of the spots on walls near the path that have a map point within SEEN_M."""
    spots = np.concatenate([_spots(r) for r in run.scene.rectangles if _is_wall(r)])
    spots = spots[_visible(run, spots)]
    taken = {tuple(cell) for cell in np.floor(points / SEEN_M).astype(int).tolist()}
    return float(np.mean([_touched(cell, taken) for cell in np.floor(spots / SEEN_M).astype(int).tolist()]))


def _touched(cell: list[int], taken: set[tuple[int, ...]]) -> bool:
    """Whether the cell or one beside it is taken."""
    x, y, z = cell
    return any((x + i, y + j, z + k) in taken for i in (-1, 0, 1) for j in (-1, 0, 1) for k in (-1, 0, 1))


def _is_wall(r: Rectangle) -> bool:
    return abs(r.normal[2]) < 0.1 and r.width_m > 1.0


def _spots(r: Rectangle) -> Array:
    """Points (N, 3) on a grid over a wall, at heights that a robot's cameras see well."""
    across = (np.arange(max(1, round(r.width_m / SPOT_M))) + 0.5) / max(1, round(r.width_m / SPOT_M))
    down = (np.arange(max(1, round(r.height_m / SPOT_M))) + 0.5) / max(1, round(r.height_m / SPOT_M))
    u, v = np.meshgrid(across, down)
    points = r.points(np.column_stack([u.ravel(), v.ravel()]))
    return points[(points[:, 2] > HEIGHT_M[0]) & (points[:, 2] < HEIGHT_M[1])]


def _visible(run: Run, spots: Array) -> Array:
    """Which spots (N, 3) some pose sees from less than NEAR_M."""
    seen = np.zeros(len(spots), bool)
    for T in run.poses[::5]:
        todo = ~seen & (np.hypot(*(spots - T[:3, 3])[:, :2].T) < NEAR_M)
        seen[todo] |= sees(run.scene, T[:3, 3], spots[todo])
    return seen
