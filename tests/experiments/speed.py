"""Section VI: the time of SAD and KLT against that of SIFT features, on the same panoramas in one run."""

from __future__ import annotations

import time
from collections.abc import Callable
from itertools import pairwise
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from calib.models.camera import Array
from omnid.core.odometry.corners import corners
from omnid.core.odometry.tracking import Image, KltSettings, track
from omnid.core.odometry.yaw_search import correlation_peaks
from omnid.messages import Panoramas
from tests.experiments.views import Experiment, look
from tests.experiments.wall_matching import stereo

FEATURES = 500
RATIO = 0.8  # of Lowe 2004: the best match is so much nearer than the second
Task = Callable[[Panoramas, Panoramas], object]


def measure(folder: Path, experiment: Experiment) -> dict[str, Any]:
    """Median milliseconds a pair takes, one thread: depth and tracks by SAD and KLT, and both by SIFT."""
    views = look(folder)
    threads = cv2.getNumThreads()
    cv2.setNumThreads(1)
    try:
        tasks: dict[str, Task] = {
            "depth: original SAD": _depth(stereo(views, "sad").process),
            "depth: enhanced SAD": _depth(stereo(views, "enhanced").process),
            "depth: SAD with a semi-global prior (omnid)": _depth(stereo(views, "semiglobal").process),
            "motion: corners, correlation, KLT there and back": _tracked,
            "both: SIFT of two panoramas, matched with each other and with those before": _Sift(),
        }
        return {name: _median_ms(task, views.panoramas) for name, task in tasks.items()}
    finally:
        cv2.setNumThreads(threads)


def _median_ms(task: Task, panoramas: list[Panoramas]) -> float:
    """The first pairs warm buffers up; the median does not mind."""
    times_s = []
    for before, now in pairwise(panoramas):
        started = time.perf_counter()
        task(before, now)
        times_s.append(time.perf_counter() - started)
    return 1e3 * float(np.median(times_s))


def _depth(process: Callable[[Panoramas], object]) -> Task:
    return lambda _, now: process(now)


def _tracked(before: Panoramas, now: Panoramas) -> object:
    points = corners(before.lower, before.visible, FEATURES)
    turn = correlation_peaks(before.lower.panorama, now.lower.panorama, now.visible, 1)[0]
    shift = np.array([turn * before.lower.width / (2 * np.pi), 0.0])
    return track(before.lower, now.lower, points, points + shift, KltSettings())


class _Sift:
    """Features of both panoramas, matched for depth, and with those of the pair before for motion."""

    def __init__(self) -> None:
        self._sift = cv2.SIFT.create()
        self._before: Array | None = None

    def __call__(self, _: Panoramas, now: Panoramas) -> object:
        lower, upper = self._describe(now.lower.panorama), self._describe(now.upper.panorama)
        before, self._before = self._before, lower
        return _matches(lower, upper), before is not None and _matches(before, lower)

    def _describe(self, panorama: Image) -> Array:
        return np.asarray(self._sift.detectAndCompute(panorama, None)[1])


def _matches(a: Array, b: Array) -> int:
    """How many features of a have one in b that is clearly nearest."""
    nearest = cv2.BFMatcher(cv2.NORM_L2).knnMatch(a, b, k=2)
    return sum(len(two) == 2 and two[0].distance < RATIO * two[1].distance for two in nearest)
