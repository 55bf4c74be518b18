"""Figures of the paper's and omnid's methods on the rendered logs of section V, by the exact truth of their scenes."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

import omnid
from calib import se3
from calib.models.camera import Array
from omnid.config import Config
from omnid.core.odometry.corners import corners
from omnid.core.odometry.paper.paper_odometry import turned_track
from omnid.core.odometry.stereo_frame import StereoFrame
from omnid.core.odometry.tracking import KltSettings, correlation_peaks, flow
from omnid.core.stereo.matcher import edge_pixels, smooth
from omnid.core.types.panorama import Panoramas
from omnid.formats.tum import Trajectory, read_tum
from omnid.recordings.evaluation import evaluate
from omnid.simulation.rendering.surfaces import Rectangle, Scene
from omnid.stages.geometry import DenseDepths
from tests.bench.paper.scenes import TURNS_DEG, WALL_M, Experiment, Views
from tests.bench.results import Cell
from tests.simulation.recipes import SimulatedRun

Indices = NDArray[np.intp]
Flags = NDArray[np.bool_]
TOUCHING_M = 1e-6


def cast(scene: Scene, origin: Array, rays: Array) -> tuple[Array, Indices]:
    """Return the distances (N,) and rectangles (N,) that rays (N, 3) from a point (3,) hit first.

    Distances are in units of each ray; inf and -1 where nothing is hit.
    """
    nearest, which = np.full(len(rays), np.inf), np.full(len(rays), -1)
    for number, rectangle in enumerate(scene):
        distance = _intersect(rectangle, origin, rays)
        nearer = distance < nearest
        nearest[nearer], which[nearer] = distance[nearer], number
    return nearest, which


def _intersect(r: Rectangle, origin: Array, rays: Array) -> Array:
    """Return the distance (N,) along the rays to one rectangle, inf where they miss it."""
    with np.errstate(divide="ignore", invalid="ignore"):
        distance = ((r.origin - origin) @ r.normal) / (rays @ r.normal)
        uv = _fractions(r, origin + distance[:, None] * rays)
        hit = (distance > TOUCHING_M) & ((uv >= 0) & (uv <= 1)).all(axis=1)
    return np.where(hit, distance, np.inf)


def _fractions(r: Rectangle, points: Array) -> Array:
    """Return the positions (N, 2) of points (N, 3) along both edges, as fractions of the edges."""
    along = points - r.origin
    return np.column_stack([along @ r.edge_u / r.width_m**2, along @ r.edge_v / r.height_m**2])


def sees(scene: Scene, origin: Array, points: Array, slack_m: float = 0.02) -> Flags:
    """Return which points (N, 3) are visible from a viewpoint (3,)."""
    rays = points - origin
    distance, _ = cast(scene, origin, rays)
    return np.asarray((distance - 1) * np.linalg.norm(rays, axis=1) > -slack_m)


def surface_distance_m(scene: Scene, points: Array) -> Array:
    """Return the distance (N,) of points (N, 3) from the nearest surface."""
    nearest = np.full(len(points), np.inf)
    for r in scene:
        uv = np.clip(_fractions(r, points), 0, 1)
        nearest = np.minimum(nearest, np.linalg.norm(points - r.points(uv), axis=1))
    return nearest


# V.B, fig. 8: SAD, enhanced SAD and omnid's matching on a wall of identical bricks, a control and a smooth wall.

SAD_METHODS: Final = {"original SAD": "sad", "enhanced SAD": "enhanced", "semi-global (omnid)": "semiglobal"}
WRONG_M: Final = 0.05  # largest distance of a right point from the wall
MISMATCHED_M: Final = 0.2  # a point farther off is not only located inexactly
HALF_ANGLE_DEG: Final = 45.0  # from straight ahead; farther along the wall, 5 cm are within the noise of the depth
CELL_M: Final = 0.1  # side of the squares of the wall of which the covered ones are counted


class WallFigures(NamedTuple):
    """Figures of a method on a wall: shares in per cent."""

    matches: float  # a pair
    wrong: float  # over WRONG_M off
    mismatched: float  # over MISMATCHED_M off
    completeness: float  # right matches of the edge pixels, which every SAD method tries to match
    coverage: float  # of the squares of the wall within HALF_ANGLE_DEG, those that hold a right match
    rms_mm: float  # of the right ones


def walls(folder: Path, experiment: Experiment) -> dict[str, WallFigures]:
    """Return the figures of each method on the matches that truly show the wall."""
    run, views, stereo = experiment.run, Views.load(folder), Config().stereo
    wall = next(face for face in run.scene if face.name == "wall")
    squares = round(2 * WALL_M * np.tan(np.deg2rad(HALF_ANGLE_DEG)) / CELL_M) * round(wall.height_m / CELL_M)
    found = {}
    for name, method in SAD_METHODS.items():
        dense = DenseDepths(views.geometry, replace(stereo, matching=replace(stereo.matching, method=method)))
        errors, covered, edges = [], [], 0
        for panoramas, T_world_rig in zip(views.panoramas, run.poses, strict=True):
            depth = dense.points(panoramas)
            on_wall, spots = _wall_points(run, views, T_world_rig, depth.pixels)
            errors.append(se3.apply(T_world_rig, depth.points)[on_wall, 0] - WALL_M)
            right = spots[on_wall, 1:][np.abs(errors[-1]) <= WRONG_M] - [T_world_rig[1, 3], 0.0]
            covered.append(len(np.unique(np.floor(right / CELL_M), axis=0)) / squares)
            edges += int(_wall_points(run, views, T_world_rig, _edges(panoramas))[0].sum())
        off_m = np.abs(np.concatenate(errors))
        right_m = off_m[off_m <= WRONG_M]
        found[name] = WallFigures(
            len(off_m) / len(errors),
            *(100 * float((off_m > limit_m).mean()) for limit_m in (WRONG_M, MISMATCHED_M)),
            100 * len(right_m) / edges,
            100 * float(np.mean(covered)),
            1e3 * float(np.sqrt(np.mean(right_m**2))),
        )
    return found


def _wall_points(run: SimulatedRun, views: Views, T_world_rig: Array, pixels: Array) -> tuple[Flags, Array]:
    """Return which pixels (N, 2) show the wall within HALF_ANGLE_DEG of straight ahead, and their points (N, 3)."""
    rays = views.rays(pixels) @ T_world_rig[:3, :3].T
    origin = views.viewpoint(T_world_rig)
    distance, which = cast(run.scene, origin, rays)
    wall = [number for number, face in enumerate(run.scene) if face.name == "wall"]
    ahead = np.abs(np.arctan2(rays[:, 1], rays[:, 0])) <= np.deg2rad(HALF_ANGLE_DEG)
    return np.isin(which, wall) & ahead, origin + np.where(np.isfinite(distance), distance, 0)[:, None] * rays


def _edges(panoramas: Panoramas) -> Array:
    """Return the pixels (N, 2) of the lower panorama that every SAD method tries to match."""
    matching = Config().stereo.matching
    image = smooth(panoramas.lower.panorama, matching.sigma_px)
    flat = edge_pixels(image, panoramas.visible, matching.edge_threshold, matching.max_points)
    rows, columns = np.divmod(flat, image.shape[1])
    return np.column_stack([columns, rows]).astype(float)


# IV.F, fig. 7: plain KLT, the search in steps of 18 degrees and correlation, through turns of -180 to 180 degrees.

FEATURES: Final = 500
RIGHT_PX: Final = 3.0  # largest distance of a right feature from its true pixel
Tracker = Callable[[StereoFrame, StereoFrame, Array], tuple[Array, Flags]]


def _correlated(before: StereoFrame, after: StereoFrame, features: Array) -> tuple[Array, Flags]:
    peaks = correlation_peaks(before.lower.panorama, after.lower.panorama, after.usable)
    return turned_track(before, after, features, KltSettings(), peaks)


TRACKERS: Final[dict[str, Tracker]] = {
    # By Lucas and Kanade's own status, as the paper does.
    "plain KLT": lambda before, after, at: flow(before.lower, after.lower, at, at, KltSettings()),
    "18° steps": lambda before, after, at: turned_track(before, after, at, KltSettings()),
    "correlation": _correlated,
}


@dataclass(frozen=True, slots=True)
class Turn:
    """A turn from one pair to another: its angle, positive to the left, and the features that were followed."""

    angle_deg: float
    features: int
    right: dict[str, int]  # by tracker: claimed, and within RIGHT_PX
    claimed: dict[str, int]


def turns(folder: Path, experiment: Experiment) -> Iterator[Turn]:
    """Yield the turns from the first pair of the log to each other one, and the ways back."""
    run, views = experiment.run, Views.load(folder)
    frames = [
        StereoFrame(p.seq, p.lower, p.upper, np.full(p.visible.shape, np.nan, np.float32), p.visible)
        for p in views.panoramas
    ]
    for number, angle_deg in enumerate(TURNS_DEG[: len(frames) - 1], 1):
        yield _turn(run, views, frames, (0, number), angle_deg)
        if angle_deg:
            yield _turn(run, views, frames, (number, 0), -angle_deg)


def _turn(run: SimulatedRun, views: Views, frames: list[StereoFrame], pair: tuple[int, int], angle_deg: float) -> Turn:
    """Track corners of one pair into another, and count those that are found where they truly are."""
    (before, after), (T_before, T_after) = (frames[n] for n in pair), (run.poses[n] for n in pair)
    # 1. Corners of the first panorama, and the points of the scene that they show.
    pixels = corners(before.lower, before.usable, FEATURES)
    origin, rays = views.viewpoint(T_before), views.rays(pixels) @ T_before[:3, :3].T
    distance, _ = cast(run.scene, origin, rays)
    hit = np.isfinite(distance)
    pixels, points = pixels[hit], origin + distance[hit, None] * rays[hit]
    # 2. Where the second panorama truly shows them.
    true_pixels, visible = views.pixels(T_after, points), sees(run.scene, views.viewpoint(T_after), points)
    right, claimed = {}, {}
    for name, tracker in TRACKERS.items():
        found, is_claimed = tracker(before, after, pixels)
        error = found - true_pixels
        error[:, 0] = views.geometry.cylinder.wrap(error[:, 0])
        claimed[name] = int(is_claimed.sum())
        right[name] = int((is_claimed & visible & (np.hypot(*error.T) <= RIGHT_PX)).sum())
    return Turn(angle_deg, len(pixels), right, claimed)


# V.C, fig. 9, V.D, fig. 10: paths between two walls and around a building.

SAD, ENHANCED = "stereo.matching.method=sad", "stereo.matching.method=enhanced"
PAPER, KLT = "odometry.method=paper", "odometry.tracker=klt"
THE_PAPER: Final = "enhanced SAD, improved KLT, eq. 9 (the paper)"
OMNID: Final = "bearings, keyframes, semi-global prior (omnid)"
METHODS: Final = {  # settings; each step from the paper's method to omnid's
    "original SAD, plain KLT, eq. 9": (PAPER, SAD, KLT),
    "enhanced SAD, plain KLT, eq. 9": (PAPER, ENHANCED, KLT),
    THE_PAPER: (PAPER, ENHANCED),
    OMNID: (),
}


def path(folder: Path, method: str) -> list[Cell]:
    """Return the errors of a log by a method: length [%], ATE, end [mm], heading [deg]."""
    result = omnid.replay(folder / "log.mcap", folder / "rig.toml", overrides=list(METHODS[method]))
    found = evaluate(Trajectory(result.stamps_ns, result.T_odom_rig), read_tum(folder / "truth.txt"))
    lengths = (1e3 * found.ate_rmse_m, 1e3 * found.end_error_m)
    return [100 * found.length_error_ratio, *lengths, math.degrees(found.heading_max_rad)]
