"""Motion from landmarks and their views in both cameras: RANSAC on three points, then Gauss-Newton."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from calib import se3
from omnid.core.stereo import view_kernels
from omnid.core.stereo.triangulation import motion_jacobian, triangulate, view
from omnid.core.types.stereo_model import StereoModel

Array = NDArray[np.float64]
Flags = NDArray[np.bool_]

VIEW, POSE = 3, 6  # numbers of a view and of a step
# Largest error of a view in the consensus set. Measured: with 1.34 and 3 px the odometry's error is 0.96 and 1.01 times
# as large.
RANSAC_THRESHOLD_PX = 2.0
# Hypotheses that are drawn at once and at most, and the probability that none of them was free of outliers at which the
# search ends: half a day's drive misses one. The most are enough where 31 % of the landmarks are right.
RANSAC_BATCH, RANSAC_MOST, RANSAC_MISSED = 16, 480, 1e-6
# Steps at most, after the first of which outliers do not count any more.
GAUSS_NEWTON_STEPS, OUTLIER_STEPS = 6, 2  # enough: 305 of 306 fits of test_pose_estimation.py converge in 5
CONVERGED = 1e-5  # m and rad: a smaller step is the last one, because it moves no view by a hundredth of a pixel
# Standard deviations at which the Cauchy kernel halves the weight of an error, so that of normal errors 96 % of the
# efficiency of least squares remains (2.385: 95 %, Holland and Welsch 1977).
KERNEL_WIDTH = 2.5
# Squared Mahalanobis distance from which a measurement is an outlier: 4 sigma. Of normal errors of a view, which has
# three components, one in a thousand is farther away, so that hardly any is lost.
OUTLIER_SQUARED = 16.0
# Measurements that count as one in a covariance: neighbouring landmarks have texture, depth and keyframe in common, and
# a landmark its texture in successive frames, so that their errors are correlated.
CORRELATED = 4.0
DAMPING = 1e-9  # added to the normal equations' diagonal, so that few landmarks do not make them singular


def cost(squared: Array | float) -> Array:
    """Return minus the logarithm of the likelihood of views by their squared distances, by those that count as one."""
    return np.asarray(KERNEL_WIDTH**2 / 2 * np.log1p(np.asarray(squared) / KERNEL_WIDTH**2) / CORRELATED)


def rigid_fit(a: Array, b: Array) -> Array:
    """Return T_b_a (..., 4, 4) that moves points a (..., N, 3) onto b with least squares (Kabsch), no reflection."""
    mean_a, mean_b = a.mean(axis=-2, keepdims=True), b.mean(axis=-2, keepdims=True)
    U, _, Vt = np.linalg.svd(np.swapaxes(b - mean_b, -1, -2) @ (a - mean_a))
    U[..., :, 2] *= np.sign(np.linalg.det(U) * np.linalg.det(Vt))[..., None]
    R = U @ Vt
    return se3.transform(R, (mean_b[..., 0, :, None] - R @ mean_a[..., 0, :, None])[..., 0])


def ransac(
    landmarks: Array,
    views: Array,
    model: StereoModel,
    rng: np.random.Generator,
    threshold_px: float = RANSAC_THRESHOLD_PX,
) -> tuple[Array, Flags]:
    """Return the motion T_curr_ref with the largest consensus set of landmarks (N, 3), and the set's flags (N,).

    The distance is measured in the views (N, 3) [px], where the noise is even; an unknown upper row counts as right.
    """

    def agree(motions: Array) -> Flags:
        moved = se3.apply(motions, landmarks)
        error = views - view(moved.reshape(-1, 3), model.cylinder, model.baseline_m).reshape(moved.shape)
        error[..., 0] = model.cylinder.wrap(error[..., 0])
        return np.asarray(~(np.abs(error) >= threshold_px).any(axis=2))

    return consensus(landmarks, triangulate(views, model.cylinder, model.baseline_m), agree, rng)


def consensus(a: Array, b: Array, agree: Callable[[Array], Flags], rng: np.random.Generator) -> tuple[Array, Flags]:
    """Return the motion T_b_a with the largest consensus set of points (N, 3), and the set's flags (N,).

    Three pairs of points, of which b may be NaN where it is unknown, give a hypothesis: Dang et al. 2012, section IV.B.
    agree: returns flags (K, N) of the points that agree with motions (K, 4, 4). No motion is the first hypothesis.
    Others are drawn in batches until three inliers have almost certainly been among them, also where most agree with
    the first: a few that are near tell a turn from a step aside, and the others agree with both.
    """
    usable, best = np.flatnonzero(np.isfinite(b).all(axis=1)), np.eye(4)
    if len(usable) < 3:
        return best, agree(best[None])[0]
    for drawn in range(RANSAC_BATCH, RANSAC_MOST + 1, RANSAC_BATCH):
        triples = usable[rng.random((RANSAC_BATCH, len(usable))).argpartition(2, axis=1)[:, :3]]
        motions = np.concatenate([best[None], rigid_fit(a[triples], b[triples])])
        agreeing = agree(motions)
        most = int(agreeing.sum(axis=1).argmax())
        best, chosen = motions[most], agreeing[most]
        if (1 - float(chosen.mean()) ** 3) ** drawn < RANSAC_MISSED:
            break
    return best, chosen


@dataclass(frozen=True, slots=True)
class GaussNewtonResult:
    """Motion T_curr_ref with its covariance (6, 6) [t; r] in curr, and what each view adds to it."""

    T: Array
    covariance: Array  # of independent views whose noise is as large as their errors say
    squared: Array  # (N,) squared Mahalanobis distance of each view
    by_landmark: Array  # (N, 6, 6) derivatives of the motion by one of each landmark, both [t; r] in curr


def gauss_newton(
    landmarks: Array,
    covariance: Array,
    views: Array,
    T: Array,
    model: StereoModel,
    noise: Array | float = 0.0,
    shared: tuple[Array, Array] | None = None,
) -> GaussNewtonResult:
    """Return the motion T_curr_ref (4, 4) that best explains the views (N, 3), from a start T.

    Minimises the sum of rho(e^T S^-1 e) over the bearings of both cameras, rho the Cauchy kernel, cut off at outliers
    once the motion is near, S the covariance of a view by its corner (sigma_px, and noise (N, 3, 3) [px^2] in addition
    to it) and by its landmark (covariance (N, 3, 3)). shared: derivatives (N, 3, K) [px] of the true views
    by an error of K components that all have in common, such as that of a velocity, and its covariance (K, K); it is
    estimated along with the motion. A view without the upper row (NaN) counts by the lower camera alone. It replaces
    eq. (9) of Dang et al. 2012, which measures in 3-D and is biased short.
    """
    by_error, of_error = (np.zeros((len(views), 3, 0)), np.zeros((0, 0))) if shared is None else shared
    size = POSE + len(of_error)
    prior = np.diag(np.full(size, DAMPING))
    if len(of_error):
        prior[POSE:, POSE:] += np.linalg.inv(of_error)
    # 1. The information of the views, at the start. An upper row that is not known has none.
    by_motion = motion_jacobian(se3.apply(T, landmarks), model.cylinder, model.baseline_m)
    by_landmark = by_motion[:, :, :3] @ T[:3, :3]
    S = by_landmark @ covariance @ np.swapaxes(by_landmark, 1, 2) + model.sigma_px**2 * np.eye(3) + noise
    is_lower_only = np.isnan(views[:, 2])
    S[is_lower_only, 2], S[is_lower_only, :, 2] = 0.0, 0.0
    S[is_lower_only, 2, 2] = 1.0
    information = np.asarray(np.linalg.inv(S), float)
    information[is_lower_only, 2, 2] = 0.0
    # 2. Steps. If one is short, the last equations hold after it as well.
    cylinder, focal_px = model.cylinder, model.cylinder.focal_px
    column0 = cylinder.left_rad * focal_px - 0.5
    camera = focal_px, column0, cylinder.row0, float(cylinder.period_px), model.baseline_m
    views, error, blank = np.nan_to_num(views), np.zeros(size - POSE), np.zeros((len(views), VIEW, POSE))
    E = np.concatenate([blank, -by_error, blank[:, :, :1]], axis=2)
    informed = information @ E
    for number in range(GAUSS_NEWTON_STEPS + 1):
        # E = [J, e]: errors e = v - view(T p) + D s, and their derivatives -J by [t; r] on the left of T and by s.
        view_kernels.compare(T, landmarks, views + by_error @ error, information, camera, E, informed)
        squared = (E[:, :, -1] * informed[:, :, -1]).sum(axis=1)
        weight = 1 / (1 + squared / KERNEL_WIDTH**2)
        is_right = squared < OUTLIER_SQUARED
        if number >= OUTLIER_STEPS and is_right.sum() >= POSE:  # fewer leave the equations singular
            weight = np.where(is_right, weight, 0.0)
        weighted = (informed[:, :, :size] * weight[:, None, None]).reshape(-1, size).T
        sums = weighted @ E.reshape(-1, size + 1)
        H, g = prior + sums[:, :size], sums[:, size] - prior[:, POSE:] @ error
        if number == GAUSS_NEWTON_STEPS:
            break
        step = np.linalg.inv(H) @ g
        T, error = se3.exp(step[:POSE]) @ T, error + step[POSE:]
        if np.abs(step[:POSE]).max() < CONVERGED:
            break
    # 3. The covariance, by the noise that the errors show: N numbers have squares of N - 6 in the mean. Six are added,
    #    so that views without an error do not make the pose exact. Views that share an error of the velocity agree
    #    better with each other than with the truth: only more noise counts then.
    numbers = int((VIEW - is_lower_only[is_right]).sum())
    share = max((float(squared[is_right].sum()) + POSE) / max(numbers, POSE), 1.0 if len(of_error) else 0.0)
    inverse = np.asarray(np.linalg.inv(H + (share - 1) * prior), float)
    # 4. A motion of a landmark changes its error by J, and the solution by H^-1 J^T S^-1 J.
    of_views = (np.linalg.inv(H)[:POSE] @ weighted).reshape(POSE, -1, VIEW)
    return GaussNewtonResult(T, share * inverse[:POSE, :POSE], squared, np.moveaxis(of_views, 1, 0) @ E[:, :, :POSE])
