"""V.D, fig. 10: once around a building; errors of the path, the gap at its end, and the map against the true walls."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from calib import se3
from calib.models.camera import Array
from omnid.core.mapping.voxel_map import MapPoints
from omnid.formats.tum import Trajectory
from omnid.simulation.rendering.surfaces import Rectangle
from tests.bench.paper.estimation import Method, estimate
from tests.bench.paper.path_following import METHODS as PATH_METHODS
from tests.bench.paper.path_following import THE_PAPER, against_truth
from tests.bench.paper.truth import sees, surface_distance_m
from tests.bench.paper.views import Experiment
from tests.simulation.recipes import SimulatedRun

METHODS: dict[str, Method] = {
    "the paper": THE_PAPER,
    "the paper without its Kalman filter": PATH_METHODS["the paper without its Kalman filter"],
    "omnid": Method(),
    "omnid without the Kalman filter": PATH_METHODS["omnid without the Kalman filter"],
}
NEAR_M = 4.0  # the map is judged within this distance from the path
SEEN_M = 0.1  # a spot of a wall counts as mapped with a point this close
SPOT_M = 0.25  # distance between the spots
HEIGHT_M = (0.3, 2.2)  # lowest and highest spot
OFF_M = (0.05, 0.2)  # limits of the errors that are counted


def measure(folder: Path, experiment: Experiment) -> dict[str, Any]:
    """Return for each method: errors of the path, the gap between end and start, and the map's errors."""
    run = experiment.run
    return {name: _errors(folder, run, *estimate(folder, method)) for name, method in METHODS.items()}


def _errors(folder: Path, run: SimulatedRun, trajectory: Trajectory, points: MapPoints | None) -> dict[str, Any]:
    true_end = se3.inverse(run.poses[0]) @ run.poses[-1]
    gap = se3.inverse(true_end) @ se3.inverse(trajectory.T[0]) @ trajectory.T[-1]
    values = against_truth(trajectory, folder) | {"end_to_start_m": float(np.linalg.norm(gap[:3, 3]))}
    return values if points is None else values | {"map": map_errors(run, points)}


def map_errors(run: SimulatedRun, points: MapPoints) -> dict[str, float]:
    """Return distances [m] of map points near the path from the nearest true surface, and the share of walls mapped."""
    in_world = se3.apply(run.poses[0], points.xyz.astype(float))
    near = _distance_from_path(run, in_world[:, :2]) < NEAR_M
    error = surface_distance_m(run.scene, in_world[near])
    off = {f"off_by_{limit:g}_m": float((error > limit).mean()) for limit in OFF_M}
    return {
        "points": int(near.sum()),
        "rms_m": float(np.sqrt((error**2).mean())),
        "median_m": float(np.median(error)),
        "completeness": _completeness(run, in_world[near]),
        **off,
    }


def _distance_from_path(run: SimulatedRun, xy: Array) -> Array:
    """Return the horizontal distance (N,) [m] of points (N, 2) from the path."""
    path = run.poses[::3, :2, 3]
    return np.asarray(np.sqrt(np.min([((xy - p) ** 2).sum(axis=1) for p in path], axis=0)))


def _completeness(run: SimulatedRun, points: Array) -> float:
    """Return the share of the spots on walls near the path that have a map point within SEEN_M."""
    spots = np.concatenate([_spots(r) for r in run.scene.rectangles if _is_wall(r)])
    spots = spots[_visible(run, spots)]
    occupied = {tuple(cell) for cell in np.floor(points / SEEN_M).astype(int).tolist()}
    return float(np.mean([_is_occupied_near(cell, occupied) for cell in np.floor(spots / SEEN_M).astype(int).tolist()]))


def _is_occupied_near(cell: list[int], occupied: set[tuple[int, ...]]) -> bool:
    """True if the cell or one of its neighbours is occupied."""
    x, y, z = cell
    return any((x + i, y + j, z + k) in occupied for i in (-1, 0, 1) for j in (-1, 0, 1) for k in (-1, 0, 1))


def _is_wall(r: Rectangle) -> bool:
    return abs(r.normal[2]) < 0.1 and r.width_m > 1.0


def _spots(r: Rectangle) -> Array:
    """Return points (N, 3) on a grid over a wall, at heights that a robot's cameras see well."""
    across = (np.arange(max(1, round(r.width_m / SPOT_M))) + 0.5) / max(1, round(r.width_m / SPOT_M))
    down = (np.arange(max(1, round(r.height_m / SPOT_M))) + 0.5) / max(1, round(r.height_m / SPOT_M))
    u, v = np.meshgrid(across, down)
    points = r.points(np.column_stack([u.ravel(), v.ravel()]))
    return points[(points[:, 2] > HEIGHT_M[0]) & (points[:, 2] < HEIGHT_M[1])]


def _visible(run: SimulatedRun, spots: Array) -> Array:
    """Return which spots (N, 3) are visible from a pose less than NEAR_M away."""
    seen = np.zeros(len(spots), bool)
    for T in run.poses[::5]:
        todo = ~seen & (np.hypot(*(spots - T[:3, 3])[:, :2].T) < NEAR_M)
        seen[todo] |= sees(run.scene, T[:3, 3], spots[todo])
    return seen
