"""Recognition of one place: features matched about a yaw, RANSAC on the bearings of both cameras, Gauss-Newton."""

from __future__ import annotations

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
