"""IV.F, fig. 7: plain KLT against the 18 degree search against correlation, through turns of 0 to 180 degrees."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from calib.models.camera import Array
from omnid.core.odometry.corners import corners
from omnid.core.odometry.paper.paper_odometry import turned_track
from omnid.core.odometry.stereo_frame import StereoFrame
from omnid.core.odometry.tracking import KltSettings, flow
from omnid.core.odometry.yaw_search import correlation_peaks
from tests.experiments.scenes import MOVED_TURNS_DEG, TURNS_DEG
from tests.experiments.truth import Flags, cast, sees
from tests.experiments.views import Experiment, Views, look
from tests.simulation.recipes import Run

FEATURES = 500
RIGHT_PX = 3.0  # from where the truth has it
REPEATS = 3  # of which the fastest counts
Tracker = Callable[[StereoFrame, StereoFrame, Array], tuple[Array, Flags]]


def _plain(before: StereoFrame, after: StereoFrame, features: Array) -> tuple[Array, Flags]:
    """Lucas and Kanade's own word, as the paper takes it."""
    return flow(before.lower, after.lower, features, features, KltSettings())


def _stepwise(before: StereoFrame, after: StereoFrame, features: Array) -> tuple[Array, Flags]:
    return turned_track(before, after, features, KltSettings())


def _correlated(before: StereoFrame, after: StereoFrame, features: Array) -> tuple[Array, Flags]:
    peaks = correlation_peaks(before.lower.panorama, after.lower.panorama, after.usable)
    return turned_track(before, after, features, KltSettings(), peaks)


TRACKERS: dict[str, Tracker] = {"plain KLT": _plain, "18° steps": _stepwise, "correlation": _correlated}


@dataclass(frozen=True, slots=True)
class Features:
    """Corners of the first panorama and the points of the scene they show."""

    pixels: Array  # (N, 2)
    points: Array  # (N, 3) m in the world


def measure(folder: Path, experiment: Experiment) -> dict[str, Any]:
    """For each turn and tracker: features claimed, those right within RIGHT_PX, and the time [ms]."""
    run, views = experiment.run, look(folder)
    frames = [StereoFrame(p.seq, p.lower, p.upper, np.full(p.visible.shape, np.nan, np.float32), p.visible)
              for p in views.panoramas]
    features = _features(run, views, frames[0])
    rows = []
    for number, (turn_deg, moved) in enumerate(turned_poses()[: len(frames) - 1], 1):
        found = {name: _count(run, views, frames, features, number, tracker) for name, tracker in TRACKERS.items()}
        rows.append({"turn_deg": turn_deg, "moved": moved, "features": len(features.pixels), "found": found})
    return {"turns": rows}


def turned_poses() -> list[tuple[float, bool]]:
    """Turn [deg] of each pair after the first, and whether it has moved as well."""
    return [(float(a), False) for a in TURNS_DEG] + [(float(a), True) for a in MOVED_TURNS_DEG]


def _features(run: Run, views: Views, frame: StereoFrame) -> Features:
    pixels = corners(frame.lower, frame.usable, FEATURES)
    origin, rays = views.viewpoint(run.poses[0]), views.rays(pixels) @ run.poses[0][:3, :3].T
    distance, _ = cast(run.scene, origin, rays)
    hit = np.isfinite(distance)
    return Features(pixels[hit], origin + distance[hit, None] * rays[hit])


def _count(run: Run, views: Views, frames: list[StereoFrame], features: Features, number: int, tracker: Tracker
           ) -> dict[str, float]:
    times_s = []
    for _ in range(REPEATS):
        started = time.perf_counter()
        there, claimed = tracker(frames[0], frames[number], features.pixels)
        times_s.append(time.perf_counter() - started)
    T_world_rig = run.poses[number]
    error = there - views.pixels(T_world_rig, features.points)
    error[:, 0] = views.place.cylinder.wrap(error[:, 0])
    seen = sees(run.scene, views.viewpoint(T_world_rig), features.points)
    right = claimed & seen & (np.hypot(*error.T) <= RIGHT_PX)
    return {"claimed": int(claimed.sum()), "right": int(right.sum()), "ms": 1e3 * min(times_s)}
