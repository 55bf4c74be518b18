"""Recognition of places: votes for keyframes, matches about a yaw, RANSAC and Gauss-Newton; what then counts."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from calib import se3
from omnid.core.odometry.pose_estimation import gauss_newton, ransac
from omnid.core.places.place_map import PlaceFeatures
from omnid.core.stereo.triangulation import point_covariance, triangulate, view
from omnid.core.types.stereo_model import StereoModel

Array = NDArray[np.float64]
Indices = NDArray[np.intp]

RATIO: Final = 0.85  # largest distance of a match, as a share of the second best one's (Lowe 2004)
# Largest difference between a match's azimuth and the yaw between both views; by trial on development seeds.
YAW_WINDOW_RAD: Final = 1.2
SIGMA_PX: Final = 0.7  # Standard deviation of corners and their disparities; by trial on development seeds.
THRESHOLD_PX: Final = 4.0  # largest error of a view in the consensus set; by trial on development seeds
MIN_MATCHES: Final = 8  # matches, and inliers among them, below which there is no pose; by trial on development seeds
REACH_PX: Final = 3.0  # Reach of the second search about the predicted views, because the next brick is not far.
# Distance of descriptors that may match in the second search; by trial on development seeds.
LARGEST_SQUARED: Final = 0.35 * 512**2
# Squared Mahalanobis distance (4 sigma) from which a view is an outlier; so that 0.1 % of right ones are lost.
OUTLIER_SQUARED: Final = 16.0
CORRELATED: Final = 4.0  # features that count as one in the covariance; by trial on development seeds
# m, rad: least standard deviations, however many features there are.
FLOOR: Final = np.diag([0.004] * 3 + [0.0007] * 3) ** 2
SECTORS: Final = 8  # Sectors of azimuth in which inliers are counted; of 45 degrees; by trial on development seeds.
# Least inliers, and sectors of azimuth that hold them, where odometry agrees; by trial on development seeds.
NEAR_INLIERS, NEAR_SECTORS = 20, 4
# The same where it gives no pose, because other worlds gave 10 inliers in 600 queries.
FAR_INLIERS, FAR_SECTORS = 24, 5
# At most PER_PLACE of the compared keyframes lie within SAME_PLACE_M of each other; by trial on development seeds.
PER_PLACE, SAME_PLACE_M = 3, 1.5
# Share of the inliers with which another place makes a recognition ambiguous; by trial on development seeds.
RUNNER_UP: Final = 0.6
# Poses farther apart are different places.
RUNNER_UP_M, RUNNER_UP_RAD = 0.5, math.radians(10)
# Features of a frame that vote, evenly spread, the strongest ones first.
VOTERS: Final = 64
BINS: Final = 24  # Bins of the yaw angle; three neighbours count together.


@dataclass(frozen=True, slots=True, eq=False)
class Recognition:
    """Pose of a frame in the frame of a keyframe, with the support for it."""

    id: int  # id of the keyframe
    T_place_rect: Array  # (4, 4)
    covariance: Array  # (6, 6) [t; r] in the frame's axes
    inliers: int
    matches: int
    sectors: int  # number of SECTORS that hold inliers


def recognise(
    here: PlaceFeatures, there: PlaceFeatures, id: int, turn_rad: float, model: StereoModel
) -> Recognition | None:
    """Return the pose of a frame among the features of a keyframe; None where they do not fit.

    turn_rad: about the yaw from the keyframe to the frame.
    """
    model = StereoModel(model.cylinder, model.baseline_m, SIGMA_PX)
    a, b = matches(there, here, turn_rad, model)
    if len(a) < MIN_MATCHES:
        return None
    points = triangulate(there.views.astype(float), model.cylinder, model.baseline_m)
    views = here.views.astype(float)
    T_rect_place, is_inlier = ransac(points[a], views[b], model, np.random.default_rng(id), THRESHOLD_PX)
    if is_inlier.sum() < MIN_MATCHES:
        return None
    first = _fit(points[a[is_inlier]], views[b[is_inlier]], T_rect_place, model)
    a2, b2 = near_matches(there, here, view(se3.apply(first[0], points), model.cylinder, model.baseline_m), model)
    if len(a2) < MIN_MATCHES:
        return None
    T, covariance, squared = _fit(points[a2], views[b2], first[0], model)
    kept = squared < OUTLIER_SQUARED
    count = int(kept.sum())
    if count < MIN_MATCHES:
        return None
    azimuth = np.floor(views[b2[kept], 0] * (SECTORS / model.cylinder.width)).astype(int) % SECTORS
    covariance = CORRELATED * max(1.0, float(squared[kept].mean()) / 3) * covariance + FLOOR
    return Recognition(id, se3.inverse(T), covariance, count, len(a), len(np.unique(azimuth)))


def _fit(points: Array, views: Array, T: Array, model: StereoModel) -> tuple[Array, Array, Array]:
    """Return the pose T_curr_ref that explains the views (N, 3), its covariance, and the squared errors (N,)."""
    spread = point_covariance(points, model.cylinder, model.baseline_m, model.sigma_px)
    result = gauss_newton(points, spread, views, T, model)
    return result.T, result.covariance, result.squared


def matches(a: PlaceFeatures, b: PlaceFeatures, turn_rad: float, model: StereoModel) -> tuple[Indices, Indices]:
    """Return indices (M,) into a and b of features that are mutual nearest neighbours and pass the ratio test.

    turn_rad: yaw from a to b, about which azimuths may differ by YAW_WINDOW_RAD.
    """
    if len(a.views) < 2 or len(b.views) < 2:
        return np.zeros(0, np.intp), np.zeros(0, np.intp)
    squared = distances(a, b)
    # Azimuth falls with the column, and a turn to the left moves the world to the right.
    turned = a.views[:, 0] + np.float32(model.cylinder.focal_px * turn_rad)
    apart = _apart(turned, b.views[:, 0], model.cylinder.width)
    squared[apart > YAW_WINDOW_RAD * model.cylinder.focal_px] = np.inf
    best = squared.argmin(axis=1)
    nearest = squared[np.arange(len(squared)), best]
    second = np.partition(squared, 1, axis=1)[:, 1]
    mutual = squared.argmin(axis=0)[best] == np.arange(len(squared))
    chosen = np.flatnonzero(mutual & (nearest < RATIO**2 * second) & np.isfinite(nearest))
    return chosen, best[chosen]


def near_matches(a: PlaceFeatures, b: PlaceFeatures, predicted: Array, model: StereoModel) -> tuple[Indices, Indices]:
    """Return indices (M,) into a and b of mutual nearest neighbours near the views (N, 3) that a pose predicts of a."""
    squared = distances(a, b)
    there = predicted.astype(np.float32)
    far = (_apart(there[:, 0], b.views[:, 0], model.cylinder.width) > REACH_PX) | (squared > LARGEST_SQUARED)
    for row in (1, 2):
        far |= np.abs(b.views[None, :, row] - there[:, None, row]) > REACH_PX
    squared[far] = np.inf
    best = squared.argmin(axis=1)
    nearest = squared[np.arange(len(squared)), best]
    mutual = squared.argmin(axis=0)[best] == np.arange(len(squared))
    chosen = np.flatnonzero(mutual & np.isfinite(nearest))
    return chosen, best[chosen]


def distances(a: PlaceFeatures, b: PlaceFeatures) -> NDArray[np.float32]:
    """Return the squared distances (N, M) of the descriptors."""
    x, y = a.descriptors.astype(np.float32), b.descriptors.astype(np.float32)
    return np.asarray((x**2).sum(axis=1)[:, None] + (y**2).sum(axis=1)[None] - 2 * x @ y.T)


def _apart(a: NDArray[np.float32], b: NDArray[np.float32], width: int) -> NDArray[np.float32]:
    """Return the distances (N, M) [px] of columns around a panorama."""
    apart = b[None] - a[:, None]
    return np.asarray(np.abs(apart - np.float32(width) * np.rint(apart / np.float32(width))))


def compare(
    here: PlaceFeatures,
    known: Mapping[int, PlaceFeatures],
    poses: Mapping[int, Array],
    most: int,
    enough: int,
    model: StereoModel,
) -> dict[int, Recognition | None]:
    """Compare a frame with the keyframes that most of its features vote for; return the recognition or None of each.

    known: features of each keyframe; poses: (4, 4) of each. At most `most` are compared, best first, until one is
    recognised with `enough` inliers.
    """
    ids = list(known)
    voted = [votes(here, known[id], model.cylinder.width) for id in ids]
    ranked = np.argsort([-count for count, _ in voted], kind="stable")
    found: dict[int, Recognition | None] = {}
    for n in spread(ranked, np.array([poses[id][:3, 3] for id in ids]), most):
        place = found[ids[n]] = recognise(here, known[ids[n]], ids[n], voted[n][1], model)
        if place is not None and place.inliers >= enough:
            break
    return found


def supported(found: Iterable[Recognition | None], *, near: bool = False) -> list[Recognition]:
    """Return the recognitions with enough support; near: odometry agrees with them."""
    inliers, sectors = (NEAR_INLIERS, NEAR_SECTORS) if near else (FAR_INLIERS, FAR_SECTORS)
    return [place for place in found if place and place.inliers >= inliers and place.sectors >= sectors]


def unambiguous(found: list[Recognition], poses: Mapping[int, Array]) -> Recognition | None:
    """Return the recognition with most inliers, None where another place has nearly as many, or none was found."""
    best = max(found, key=lambda place: place.inliers, default=None)
    if best is None:
        return None
    T = poses[best.id] @ best.T_place_rect
    rivals = (place for place in found if is_elsewhere(T, poses[place.id] @ place.T_place_rect))
    return None if any(place.inliers > RUNNER_UP * best.inliers for place in rivals) else best


def is_elsewhere(a: Array, b: Array) -> bool:
    """True if two poses (4, 4) are different places."""
    between = se3.inverse(a) @ b
    return length_m(between) > RUNNER_UP_M or angle_rad(between) > RUNNER_UP_RAD


def spread(ranked: NDArray[np.intp], at: Array, most: int) -> list[int]:
    """Return the first `most` of ranked places (N,) at positions (N, 3), at most PER_PLACE near another.

    So a second, similar place is compared as well, although all neighbours of the first are more similar.
    """
    chosen: list[int] = []
    for n in ranked.tolist():
        beside = np.linalg.norm(at[chosen] - at[n], axis=1) < SAME_PLACE_M
        if beside.sum() < PER_PLACE:
            chosen.append(n)
        if len(chosen) == most:
            break
    return chosen


def votes(here: PlaceFeatures, there: PlaceFeatures, width: int) -> tuple[int, float]:
    """Return how many features of a frame have a match in a keyframe at one turn, and that turn [rad].

    The turn is the yaw from the keyframe to the frame; width: columns of the panorama. Of places that are not the same,
    the matches are few, and their turns differ.
    """
    if len(there.views) < 2 or not len(here.views):
        return 0, 0.0
    here = here.first(VOTERS)
    squared = distances(here, there)
    best = squared.argmin(axis=1)
    nearest, second = np.partition(squared, 1, axis=1)[:, :2].T
    voting = np.flatnonzero(nearest < RATIO**2 * second)
    # A turn to the left moves the world to the right.
    turned = (here.views[voting, 0] - there.views[best[voting], 0]) % width
    counts = np.bincount((turned * (BINS / width)).astype(np.intp) % BINS, minlength=BINS)
    together = counts + np.roll(counts, 1) + np.roll(counts, -1)
    bin = int(together.argmax())
    return int(together[bin]), (bin + 0.5) * 2 * math.pi / BINS


def length_m(T: Array) -> float:
    """Return the length of the translation of a transform (4, 4)."""
    return float(np.linalg.norm(T[:3, 3]))


def angle_rad(T: Array) -> float:
    """Return the angle of the rotation of a transform (4, 4)."""
    return math.acos(min(1.0, max(-1.0, (float(np.trace(T[:3, :3])) - 1) / 2)))
