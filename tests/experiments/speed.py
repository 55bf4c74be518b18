"""Section VI: processor times of omnid's and the paper's method and of SIFT, on the same panoramas in one run."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from itertools import islice
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from calib.models.camera import Array
from omnid.config import Config
from omnid.core.odometry.corners import corners
from omnid.core.odometry.paper.registration import consensus, register
from omnid.core.odometry.tracking import KltSettings, track
from omnid.core.odometry.yaw_search import correlation_peaks
from omnid.core.stereo.triangulation import triangulate
from omnid.messages import Panoramas
from omnid.settings import load
from omnid.stages.dense_depths import DenseDepths
from omnid.stages.geometry import Geometry
from omnid.stages.odometry import OdometryStage
from tests.experiments.feature_matching import FeatureSet, descriptor_distance, mutual_matches
from tests.experiments.views import Experiment, log_geometry, panoramas_of
from tests.experiments.wall_matching import stereo

PAIRS = 40  # of the log that are measured
WARM_UP = 3  # pairs at the start that are left out: buffers are allocated, keyframes are few
FEATURES = 500  # of a panorama: what omnid and the paper's method track
COLUMN_PX = 2.0  # largest column difference of a stereo match
RANSAC_M = 0.05  # consensus threshold of the motion between SIFT points, as in the paper's method
SIFT_TASKS = {f"SIFT, {FEATURES} features": FEATURES, "SIFT, no limit": 0}


class Times:
    """Processor times of each task [s], one for every pair."""

    def __init__(self) -> None:
        self._times_s: dict[str, list[float]] = {}

    def run(self, task: str, function: Callable[[], Any]) -> Any:
        """Call a function, note its time under a task, and return its result."""
        started_s = time.process_time()
        result = function()
        self._times_s.setdefault(task, []).append(time.process_time() - started_s)
        return result

    def median_ms(self) -> dict[str, float]:
        """Return the median of each task after the warm-up [ms]."""
        return {task: 1e3 * float(np.median(times[WARM_UP:])) for task, times in self._times_s.items()}

    def sum_ms(self, *tasks: str) -> float:
        """Return the median of the sums of some tasks of the same pair [ms]."""
        return 1e3 * float(np.median(np.sum([self._times_s[task][WARM_UP:] for task in tasks], axis=0)))


def measure(folder: Path, experiment: Experiment) -> dict[str, Any]:
    """Return the median processor time a pair takes [ms] for each task, with one thread of OpenCV."""
    place, times = log_geometry(folder), Times()
    matchers = {
        name: stereo(place, method)
        for name, method in (("original SAD", "sad"), ("enhanced SAD", "enhanced"), ("semi-global prior", "semiglobal"))
    }
    computed = {name: DenseDepths(matcher.compute) for name, matcher in matchers.items()}
    default = OdometryStage(place, Config().odometry, computed["semi-global prior"])
    paper = OdometryStage(place, load(Config, overrides=("odometry.method=paper",)).odometry, computed["enhanced SAD"])
    sift = {name: SiftOdometry(place, features) for name, features in SIFT_TASKS.items()}
    before: Panoramas | None = None
    with _one_thread():
        for now in islice(panoramas_of(folder, place), PAIRS):
            for name, dense in computed.items():
                times.run(f"depth: {name}", lambda d=dense, pair=now: d.points(pair))
            if before is not None:
                times.run("tracking alone", lambda a=before, b=now: _track(a, b))
            times.run("motion of omnid", lambda pair=now: default.process(pair))
            times.run("motion of the paper", lambda pair=now: paper.process(pair))
            for name, odometry in sift.items():
                odometry.process(times, name, now)
            before = now
    return _values(times)


def _values(times: Times) -> dict[str, float]:
    """Return the rows of the table."""
    each = times.median_ms()
    rows = {f"depth: {name}": each[f"depth: {name}"] for name in ("original SAD", "enhanced SAD", "semi-global prior")}
    rows["motion, tracking alone: corners, correlation, KLT there and back"] = each["tracking alone"]
    rows["motion, all of omnid: prediction, tracking, RANSAC, Gauss-Newton, refinement, keyframes"] = each[
        "motion of omnid"
    ]
    rows["motion, all of the paper's method"] = each["motion of the paper"]
    rows["**depth and motion, omnid**"] = times.sum_ms("depth: semi-global prior", "motion of omnid")
    rows["**depth and motion, the paper's method**"] = times.sum_ms("depth: enhanced SAD", "motion of the paper")
    for name in SIFT_TASKS:
        parts = [f"{name}: {part}" for part in SiftOdometry.PARTS]
        rows[f"**depth and motion, {name}**"] = times.sum_ms(*parts)
        rows[f"{name}: detection and description in two panoramas"] = each[parts[0]]
        rows[f"{name}: matching for depth and for motion"] = each[parts[1]]
        rows[f"{name}: triangulation, RANSAC, Gauss-Newton"] = each[parts[2]]
    return rows


@contextmanager
def _one_thread() -> Iterator[None]:
    threads = cv2.getNumThreads()
    cv2.setNumThreads(1)
    try:
        yield
    finally:
        cv2.setNumThreads(threads)


def _track(before: Panoramas, now: Panoramas) -> object:
    points = corners(before.lower, before.visible, FEATURES)
    turn = correlation_peaks(before.lower.panorama, now.lower.panorama, now.visible)[0]
    shift = np.array([turn * before.lower.width / (2 * np.pi), 0.0])
    return track(before.lower, now.lower, points, points + shift, KltSettings())


@dataclass(frozen=True, slots=True)
class _Located:
    """Features of a lower panorama with a point each, NaN where stereo found none."""

    features: FeatureSet
    points: Array  # (N, 3) m


class SiftOdometry:
    """Depth and motion by SIFT alone: features of both panoramas, matched for depth and with those of the pair before.

    The motion between the matched points is the paper's: RANSAC on three points, then Gauss-Newton on eq. (9).
    """

    PARTS = ("detection", "matching", "motion")

    def __init__(self, place: Geometry, features: int) -> None:
        self._place = place
        self._sift = cv2.SIFT.create(nfeatures=features)
        self._before: _Located | None = None

    def process(self, times: Times, name: str, now: Panoramas) -> None:
        """Process a pair and note the times of the parts."""
        detection, matching, motion = (f"{name}: {part}" for part in self.PARTS)
        both = (now.lower.panorama, now.upper.panorama)
        lower, upper = times.run(detection, lambda: [self._detect(panorama) for panorama in both])
        pairs = times.run(matching, lambda: self._match(lower, upper))
        self._before = times.run(motion, lambda: self._move(now.seq, (lower, upper), *pairs))

    def _detect(self, panorama: Any) -> FeatureSet:
        keypoints, descriptors = self._sift.detectAndCompute(panorama, None)
        return FeatureSet(np.array([k.pt for k in keypoints], float).reshape(-1, 2), np.asarray(descriptors))

    def _match(self, lower: FeatureSet, upper: FeatureSet) -> tuple[Any, Any]:
        """Return the indices of the stereo matches, and of those with the pair before."""
        stereo_matches = mutual_matches(descriptor_distance(lower, upper))
        if self._before is None:
            return stereo_matches, None
        return stereo_matches, mutual_matches(descriptor_distance(self._before.features, lower))

    def _move(
        self, seq: int, panoramas: tuple[FeatureSet, FeatureSet], stereo_matches: Any, motion_matches: Any
    ) -> _Located:
        """Triangulate the stereo matches and estimate the motion since the pair before."""
        lower, upper = panoramas
        a, b = stereo_matches
        same = np.abs(lower.pixels[a, 0] - upper.pixels[b, 0]) <= COLUMN_PX
        views = np.column_stack([lower.pixels[a[same]], upper.pixels[b[same], 1]])
        points = np.full((len(lower.pixels), 3), np.nan)
        points[a[same]] = triangulate(views, self._place.cylinder, self._place.rig.baseline_m)
        if motion_matches is not None and self._before is not None:
            Ma, Mb = self._before.points[motion_matches[0]], points[motion_matches[1]]
            both = np.isfinite(Ma).all(axis=1) & np.isfinite(Mb).all(axis=1)
            M, agree = consensus(Ma[both], Mb[both], np.random.default_rng(seq), RANSAC_M)
            if agree.sum() > 2:
                register(Ma[both][agree], Mb[both][agree], M)
        return _Located(lower, points)
