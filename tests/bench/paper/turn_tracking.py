"""IV.F, fig. 7: plain KLT, the search in steps of 18 degrees and correlation, through turns of -180 to 180 degrees."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from calib.models.camera import Array
from omnid.core.odometry.corners import corners
from omnid.core.odometry.paper.paper_odometry import turned_track
from omnid.core.odometry.stereo_frame import StereoFrame
from omnid.core.odometry.tracking import KltSettings, correlation_peaks, flow
from tests.bench.paper.scenes import MOVED_TURNS_DEG, TURNS_DEG
from tests.bench.paper.truth import Flags, cast, sees
from tests.bench.paper.views import Experiment, Views, load_views
from tests.simulation.recipes import SimulatedRun

FEATURES = 500
RIGHT_PX = 3.0  # largest distance of a right feature from its true pixel
Tracker = Callable[[StereoFrame, StereoFrame, Array], tuple[Array, Flags]]


def _plain(before: StereoFrame, after: StereoFrame, features: Array) -> tuple[Array, Flags]:
    """Track by Lucas and Kanade's own status, as the paper does."""
    return flow(before.lower, after.lower, features, features, KltSettings())


def _stepwise(before: StereoFrame, after: StereoFrame, features: Array) -> tuple[Array, Flags]:
    return turned_track(before, after, features, KltSettings())


def _correlated(before: StereoFrame, after: StereoFrame, features: Array) -> tuple[Array, Flags]:
    peaks = correlation_peaks(before.lower.panorama, after.lower.panorama, after.usable)
    return turned_track(before, after, features, KltSettings(), peaks)


TRACKERS: dict[str, Tracker] = {"plain KLT": _plain, "18° steps": _stepwise, "correlation": _correlated}


@dataclass(frozen=True, slots=True)
class Turn:
    """A turn between two pairs of the log; angles to the left are positive."""

    before: int  # index of the pair that is tracked from
    after: int
    angle_deg: float
    moved: bool  # with a small translation


@dataclass(frozen=True, slots=True)
class Features:
    """Corners of a panorama and the points of the scene that they show."""

    pixels: Array  # (N, 2)
    points: Array  # (N, 3) m in the world


def measure(folder: Path, experiment: Experiment) -> dict[str, Any]:
    """Return for each turn and tracker: features claimed, those right within RIGHT_PX, and the processor time [ms]."""
    run, views = experiment.run, load_views(folder)
    frames = [
        StereoFrame(p.seq, p.lower, p.upper, np.full(p.visible.shape, np.nan, np.float32), p.visible)
        for p in views.panoramas
    ]
    threads = cv2.getNumThreads()
    cv2.setNumThreads(1)
    try:
        return {"turns": [_row(run, views, frames, turn) for turn in turns(len(frames))]}
    finally:
        cv2.setNumThreads(threads)


def turns(pairs: int) -> Iterator[Turn]:
    """Yield the turns among the first pairs of the log: from pair 0 to each other one, and the way back."""
    poses = [(float(a), False) for a in TURNS_DEG] + [(float(a), True) for a in MOVED_TURNS_DEG]
    for number, (angle_deg, moved) in enumerate(poses[: pairs - 1], 1):
        yield Turn(0, number, angle_deg, moved)
        if angle_deg:
            yield Turn(number, 0, -angle_deg, moved)


def _row(run: SimulatedRun, views: Views, frames: list[StereoFrame], turn: Turn) -> dict[str, Any]:
    features = _features(run, views, frames[turn.before], run.poses[turn.before])
    found = {
        name: _count(run, views, (frames[turn.before], frames[turn.after]), features, run.poses[turn.after], tracker)
        for name, tracker in TRACKERS.items()
    }
    return {"turn_deg": turn.angle_deg, "moved": turn.moved, "features": len(features.pixels), "found": found}


def _features(run: SimulatedRun, views: Views, frame: StereoFrame, T_world_rig: Array) -> Features:
    pixels = corners(frame.lower, frame.usable, FEATURES)
    origin, rays = views.viewpoint(T_world_rig), views.rays(pixels) @ T_world_rig[:3, :3].T
    distance, _ = cast(run.scene, origin, rays)
    hit = np.isfinite(distance)
    return Features(pixels[hit], origin + distance[hit, None] * rays[hit])


def _count(
    run: SimulatedRun,
    views: Views,
    frames: tuple[StereoFrame, StereoFrame],
    features: Features,
    T_world_rig: Array,
    tracker: Tracker,
) -> dict[str, float]:
    """Track features from the first frame into the second, whose true pose is T_world_rig, and count the right ones."""
    started_s = time.process_time()
    pixels, claimed = tracker(frames[0], frames[1], features.pixels)
    time_s = time.process_time() - started_s
    error = pixels - views.pixels(T_world_rig, features.points)
    error[:, 0] = views.geometry.cylinder.wrap(error[:, 0])
    visible = sees(run.scene, views.viewpoint(T_world_rig), features.points)
    right = claimed & visible & (np.hypot(*error.T) <= RIGHT_PX)
    return {"claimed": int(claimed.sum()), "right": int(right.sum()), "ms": 1e3 * time_s}
