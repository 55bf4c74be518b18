"""Recognition of places: a shortlist by thumbnails and votes, matches about a yaw, RANSAC, Gauss-Newton.

`PlaceSearch.find` is the algorithm for a frame in a map, `recognise` that for a frame and one keyframe.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import cache, partial
from typing import Final, NamedTuple
from weakref import WeakKeyDictionary

import numpy as np
from numpy.typing import NDArray

from calib import se3
from omnid.core.odometry.estimates import PoseEstimate
from omnid.core.odometry.local_map import Keyframe
from omnid.core.odometry.pose_estimation import CORRELATED, OUTLIER_SQUARED, GaussNewtonResult, gauss_newton, ransac
from omnid.core.odometry.stereo_frame import StereoFrame
from omnid.core.places.features import FEATURES, Signature, Thumbnail, describe, signature_of, similarities
from omnid.core.places.place_map import PlaceFeatures, PlaceKeyframe, PlaceLimits, PlaceMap
from omnid.core.stereo.triangulation import point_covariance, triangulate, view
from omnid.core.types.stereo_model import StereoModel

Array = NDArray[np.float64]
Floats = NDArray[np.float32]
Indices = NDArray[np.intp]

# Set by trial on development seeds, where a line gives no other reason.
RATIO: Final = 0.85  # largest distance of a match, as a share of the second best one's (Lowe 2004)
YAW_WINDOW_RAD: Final = 1.2  # Largest difference between a match's azimuth and the yaw between both views.
SIGMA_PX: Final = 0.7  # Standard deviation of corners and their disparities.
THRESHOLD_PX: Final = 4.0  # largest error of a view in the consensus set, and reach of the second search
MIN_MATCHES: Final = 8  # matches, and inliers among them, below which there is no pose
LARGEST_SQUARED: Final = 0.35 * 512**2  # Squared distance of descriptors that may match in the second search.
# m, rad: least standard deviations, however many features there are.
FLOOR: Final = np.diag([0.004] * 3 + [0.0007] * 3) ** 2
SECTORS: Final = 8  # Sectors of azimuth in which inliers are counted, of 45 degrees.
AMBIGUOUS: Final = 0.6  # Share of the inliers with which another place makes a recognition ambiguous.
ELSEWHERE_M, ELSEWHERE_RAD = 0.5, math.radians(10)  # Poses farther apart are different places.
NEAR_M: Final = 1.5  # Keyframes within this distance of the pose by odometry are searched, besides its error.
# Largest error of odometry, and its growth with the path [m, m/m; rad, rad/m].
GATE_M, GATE_PER_M = 0.15, 0.05
GATE_RAD, GATE_RAD_PER_M = math.radians(3), math.radians(0.4)


class Effort(NamedTuple):
    """How many keyframes a search compares, and the support that a recognition needs."""

    voted: int  # most similar thumbnails whose features vote
    compared: int  # of these, those with most votes
    inliers: int  # least inliers of a recognition
    sectors: int  # and least sectors of azimuth that hold them
    enough: int = FEATURES + 1  # inliers with which the search ends


# Where odometry knows the pose roughly, and where it gives none: other worlds gave 10 inliers in 600 queries.
NEAR: Final = Effort(16, 3, 20, 4)
FAR: Final = Effort(200, 8, 24, 5)


@dataclass(frozen=True, slots=True, eq=False)
class Recognition:
    """Pose of a frame in the frame of a keyframe, with the support for it."""

    id: int  # id of the keyframe
    T_place_rect: Array  # (4, 4)
    covariance: Array  # (6, 6) [t; r] in the frame's axes
    inliers: int
    matches: int
    sectors: int  # number of SECTORS that hold inliers

    def suffices(self, effort: Effort) -> bool:
        """True if it has the support that an effort asks for."""
        return self.inliers >= effort.inliers and self.sectors >= effort.sectors


@dataclass(frozen=True, slots=True, eq=False)
class Expected:
    """Pose in the map that odometry expects for the frame, and the path over which it has drifted."""

    T_map_rect: Array  # (4, 4)
    drift_m: Mapping[int, float]  # path by keyframe, inf: unknown; a keyframe without an entry is not searched
    recognised: bool  # places were recognised lately: one that fits well is enough

    def near(self, places: PlaceMap) -> list[int]:
        """Return the keyframes that the frame may show."""
        ids = list(self.drift_m)
        apart_m = np.linalg.norm(places.positions(ids) - self.T_map_rect[:3, 3], axis=1)
        reach_m = NEAR_M + GATE_M + GATE_PER_M * np.array(list(self.drift_m.values()))
        return [ids[n] for n in np.flatnonzero(apart_m < reach_m).tolist()]

    def confirms(self, place: Recognition, poses: Mapping[int, Array]) -> bool:
        """True if a recognition is within the largest error of odometry."""
        moved_m, turned_rad = motion_between(self.T_map_rect, poses[place.id] @ place.T_place_rect)
        drift_m = self.drift_m[place.id]
        return moved_m < GATE_M + GATE_PER_M * drift_m and turned_rad < GATE_RAD + GATE_RAD_PER_M * drift_m


class PlaceSearch:
    """Finds frames among keyframes."""

    def __init__(self, model: StereoModel) -> None:
        self._model = model
        self._signatures = WeakKeyDictionary[PlaceKeyframe, Signature]()
        self.contradicted = 0  # recognitions in a row that odometry contradicts

    def find(
        self, small: Thumbnail, features: PlaceFeatures, places: PlaceMap, where: Expected | list[int]
    ) -> Recognition | None:
        """Return the best recognition of a frame, given by its thumbnail and features; None where there is none.

        where: the pose that odometry expects, which must not contradict it; or keyframes (ids) of which odometry does
        not know where they are.
        """
        if isinstance(where, Expected):
            effort, ids = NEAR._replace(enough=2 * FAR.inliers) if where.recognised else NEAR, where.near(places)
        else:
            effort, ids = FAR, where
        # 1. The most similar thumbnails.
        if ids:
            keyframes = [places.keyframes[id] for id in ids]
            for each in keyframes:
                if each not in self._signatures:
                    self._signatures[each] = signature_of(each.thumbnail)
            others = np.array([self._signatures[each] for each in keyframes])
            ranked = np.argsort(-similarities(signature_of(small), others), kind="stable")
            ids = [ids[n] for n in ranked[: effort.voted].tolist()]
        # 2. Votes and geometry of these: the best one, unless another place is as similar.
        known = {id: places.keyframes[id].features for id in ids}
        best = search(features, known, places.poses, effort, self._model)
        # 3. Unless odometry contradicts it.
        if best is None or not isinstance(where, Expected):
            return best
        is_confirmed = where.confirms(best, places.poses)
        self.contradicted = 0 if is_confirmed else self.contradicted + 1
        return best if is_confirmed else None


def search(
    frame: PlaceFeatures,
    known: Mapping[int, PlaceFeatures],
    poses: Mapping[int, Array],
    effort: Effort,
    model: StereoModel,
) -> Recognition | None:
    """Return the place that a frame shows, None where none has the support or two have it.

    known: features of each keyframe; poses: (4, 4) of each. Those are compared for which most features of the frame
    vote, at most three near another one, so that a second, similar place is compared as well, although all
    neighbours of the first are more similar.
    """
    voted = {id: votes(frame, features, model.cylinder.width) for id, features in known.items()}
    found: dict[int, Recognition | None] = {}
    for id in sorted(known, key=lambda id: -voted[id][0]):
        if len(found) == effort.compared:
            break
        neighbours = sum(np.linalg.norm(poses[id][:3, 3] - poses[other][:3, 3]) < NEAR_M for other in found)
        if neighbours >= NEAR.compared:
            continue
        place = found[id] = recognise(frame, known[id], id, voted[id][1], model)
        if place is not None and place.inliers >= effort.enough:
            break
    supported = [each for each in found.values() if each is not None and each.suffices(effort)]
    best = max(supported, key=lambda each: each.inliers, default=None)
    for other in supported:
        assert best is not None
        T_best, T_other = (poses[each.id] @ each.T_place_rect for each in (best, other))
        moved_m, turned_rad = motion_between(T_best, T_other)
        is_elsewhere = moved_m > ELSEWHERE_M or turned_rad > ELSEWHERE_RAD
        if is_elsewhere and other.inliers > AMBIGUOUS * best.inliers:
            return None
    return best


def recognise(
    frame: PlaceFeatures, keyframe: PlaceFeatures, id: int, yaw_rad: float, model: StereoModel
) -> Recognition | None:
    """Return the pose of a frame among the features of a keyframe; None where they do not fit.

    yaw_rad: from the keyframe to the frame, roughly.
    """
    if len(frame.views) < 2 or len(keyframe.views) < 2:
        return None
    model, cylinder, baseline_m = replace(model, sigma_px=SIGMA_PX), model.cylinder, model.baseline_m
    squared = distances(keyframe, frame)
    points, views = triangulate(keyframe.views.astype(float), cylinder, baseline_m), frame.views.astype(float)
    # 1. Matches whose azimuths differ by about the yaw. Azimuth falls with the column, and a turn to the left moves the
    #    world to the right.
    turned = keyframe.views[:, 0] + np.float32(cylinder.focal_px * yaw_rad)
    is_far = _columns_apart(turned, frame.views[:, 0], cylinder.width) > YAW_WINDOW_RAD * cylinder.focal_px
    a, b = mutual_nearest(np.where(is_far, np.float32(np.inf), squared), RATIO)
    if len(a) < MIN_MATCHES:
        return None
    # 2. The pose by most of them, and by all that it explains.
    T_rect_place, is_inlier = ransac(points[a], views[b], model, np.random.default_rng(id), THRESHOLD_PX)
    if is_inlier.sum() < MIN_MATCHES:
        return None
    first = _fit(points[a[is_inlier]], views[b[is_inlier]], T_rect_place, model).T
    # 3. The pose by the matches near the views that this one predicts, also those that are similar to others.
    predicted = view(se3.apply(first, points), cylinder, baseline_m).astype(np.float32)
    is_far = squared > LARGEST_SQUARED
    is_far |= _columns_apart(predicted[:, 0], frame.views[:, 0], cylinder.width) > THRESHOLD_PX
    is_far |= (np.abs(frame.views[None, :, 1:] - predicted[:, None, 1:]) > THRESHOLD_PX).any(axis=2)
    a2, b2 = mutual_nearest(np.where(is_far, np.float32(np.inf), squared))
    if len(a2) < MIN_MATCHES:
        return None
    fit = _fit(points[a2], views[b2], first, model)
    # 4. Its support.
    kept = fit.squared < OUTLIER_SQUARED
    count = int(kept.sum())
    if count < MIN_MATCHES:
        return None
    azimuth = np.floor(views[b2[kept], 0] * (SECTORS / cylinder.width)).astype(int) % SECTORS
    covariance = CORRELATED * fit.covariance + FLOOR
    return Recognition(id, se3.inverse(fit.T), covariance, count, len(a), len(np.unique(azimuth)))


def _fit(points: Array, views: Array, T: Array, model: StereoModel) -> GaussNewtonResult:
    """Return the pose T_curr_ref that explains the views (N, 3), from a start T."""
    spread = point_covariance(points, model.cylinder, model.baseline_m, model.sigma_px)
    return gauss_newton(points, spread, views, T, model)


def mutual_nearest(squared: Floats, ratio: float = np.inf) -> tuple[Indices, Indices]:
    """Return rows and columns (M,) of the elements of squared distances (N, K) that are the least of both.

    Infinite elements match none. ratio: largest ratio of a distance to the second least of its row.
    """
    best, rows = squared.argmin(axis=1), np.arange(len(squared))
    nearest, second = squared[rows, best], np.partition(squared, 1, axis=1)[:, 1]
    is_mutual = (squared.argmin(axis=0)[best] == rows) & np.isfinite(nearest)
    chosen = np.flatnonzero(is_mutual if np.isinf(ratio) else is_mutual & (nearest < ratio**2 * second))
    return chosen, best[chosen]


def distances(a: PlaceFeatures, b: PlaceFeatures) -> Floats:
    """Return the squared distances (N, M) of the descriptors."""
    x, y = a.descriptors.astype(np.float32), b.descriptors.astype(np.float32)
    return np.asarray((x**2).sum(axis=1)[:, None] + (y**2).sum(axis=1)[None] - 2 * x @ y.T)


def _columns_apart(a: Floats, b: Floats, width: int) -> Floats:
    """Return the distances (N, M) [px] of columns around a panorama."""
    apart = b[None] - a[:, None]
    return np.asarray(np.abs(apart - np.float32(width) * np.rint(apart / np.float32(width))))


def votes(frame: PlaceFeatures, keyframe: PlaceFeatures, width: int) -> tuple[int, float]:
    """Return how many features of a frame have a match in a keyframe at one yaw from keyframe to frame, and it [rad].

    width: columns of the panorama. Different places have few matches, and these differ in yaw.
    """
    if len(keyframe.views) < 2 or not len(frame.views):
        return 0, 0.0
    frame = frame.first(FEATURES // 3)  # evenly spread, the strongest ones
    squared = distances(frame, keyframe)
    best = squared.argmin(axis=1)
    nearest, second = np.partition(squared, 1, axis=1)[:, :2].T
    voting = np.flatnonzero(nearest < RATIO**2 * second)
    # A turn to the left moves the world to the right.
    turned = (frame.views[voting, 0] - keyframe.views[best[voting], 0]) % width
    bins = 3 * SECTORS  # of the yaw angle; three neighbours count together
    counts = np.bincount((turned * (bins / width)).astype(np.intp) % bins, minlength=bins)
    together = counts + np.roll(counts, 1) + np.roll(counts, -1)
    bin = int(together.argmax())
    return int(together[bin]), (bin + 0.5) * math.tau / bins


def motion_between(a: Array, b: Array) -> tuple[float, float]:
    """Return the distance [m] and the angle [rad] between two poses (4, 4)."""
    T = se3.inverse(a) @ b
    return float(np.linalg.norm(T[:3, 3])), math.acos(min(1.0, max(-1.0, (float(np.trace(T[:3, :3])) - 1) / 2)))


class Relocaliser:
    """Finds the pose of odometry after a break among its own newest keyframes, as a place is recognised.

    It keeps as many keyframes as a search compares.
    """

    def __init__(self, model: StereoModel) -> None:
        self._model = replace(model, cylinder=model.cylinder.full_turn)  # Columns of features are those of a full turn.
        self._kept: deque[tuple[Keyframe, Callable[[], PlaceFeatures]]] = deque(maxlen=FAR.compared)

    def add(self, frame: StereoFrame, keyframe: Keyframe) -> None:
        """Keep a frame and its keyframe; one near the last keyframe replaces it. It is described when it is needed."""
        if self._kept:
            apart_m = self._kept[-1][0].T_odom_rect[:3, 3] - keyframe.T_odom_rect[:3, 3]
            if np.linalg.norm(apart_m) < PlaceLimits().keyframe_m:
                self._kept.pop()
        # A function of disparities keeps all evidence of its pair.
        self._kept.append((keyframe, cache(partial(describe, replace(frame, disparities=frame.disparity)))))

    def clear(self) -> None:
        """Remove all keyframes."""
        self._kept.clear()

    def locate(self, frame: StereoFrame) -> PoseEstimate | None:
        """Return the pose with the most inliers; None where no keyframe is recognised. The keyframe is exact."""
        known = {keyframe.seq: features() for keyframe, features in self._kept}
        poses = {keyframe.seq: keyframe.T_odom_rect for keyframe, _ in self._kept}
        best = search(describe(frame), known, poses, NEAR._replace(compared=len(poses)), self._model)
        if best is None:
            return None
        matches = max(best.matches, best.inliers)
        return PoseEstimate(poses[best.id] @ best.T_place_rect, best.covariance, matches, matches, best.inliers)
