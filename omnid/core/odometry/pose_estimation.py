"""Motion from landmarks and their views in both cameras: RANSAC on three points, then Gauss-Newton."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from calib import se3
from omnid.core.odometry import pose_kernels, ransac_kernels
from omnid.core.stereo.triangulation import triangulate
from omnid.core.types.stereo_model import StereoModel

Array = NDArray[np.float64]
Flags = NDArray[np.bool_]

# Largest error of a view in the consensus set. Measured: with 1.34 and 3 px the odometry's error is 0.96 and 1.01 times
# as large.
RANSAC_THRESHOLD_PX = 2.0
GAUSS_NEWTON_STEPS = 6  # enough: 305 of 306 fits of test_pose_estimation.py converge in 5
CONVERGED = 1e-5  # m and rad: a smaller step is the last one, because it moves no view by a hundredth of a pixel
# Noise of no views: the compiled function would not take None.
NO_NOISE = np.zeros((0, 3, 3))


@dataclass(frozen=True, slots=True)
class SharedError:
    """An unknown error of K components that all N views have in common, such as that of a velocity."""

    derivatives: Array  # (N, 3, K) px: of the true views by the error
    covariance: Array  # (K, K)

    @staticmethod
    def none(count: int) -> SharedError:
        """Return the error of no components for count views."""
        return SharedError(np.zeros((count, 3, 0)), np.zeros((0, 0)))

    def of(self, chosen: Flags) -> SharedError:
        """Return the error of the views that are flagged (N,)."""
        return SharedError(self.derivatives[chosen], self.covariance)


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

    Three of the points seen in both cameras give a hypothesis; the errors of the views [px] give its consensus set:
    Dang et al. 2012, section IV.B, with the distance measured in the images, where the noise is even. Hypotheses are
    drawn in batches until three inliers have almost certainly been among them.
    """
    seen = triangulate(views, model.cylinder, model.baseline_m)
    best, consensus = np.empty((4, 4)), np.empty(len(landmarks), bool)
    seed = rng.integers(2**64, dtype=np.uint64)
    ransac_kernels.ransac(landmarks, views, seen, model.camera, threshold_px, seed, best, consensus)
    return best, consensus


def whitening(
    landmarks: Array, covariance: Array, views: Array, T: Array, model: StereoModel, noise: Array | None = None
) -> Array:
    """Return W (N, 3, 3) with W S W^T = I for the covariance S of each view's error: corner and landmark noise.

    noise: covariance (N, 3, 3) [px^2] of the views in addition to sigma_px; None: none.
    A view without the upper row (NaN) gets a row of zeros there.
    """
    W = np.empty((len(landmarks), 3, 3))
    pose_kernels.whiten(
        landmarks, covariance, views, T, model.camera, model.sigma_px, NO_NOISE if noise is None else noise, W
    )
    return W


@dataclass(frozen=True, slots=True)
class GaussNewtonResult:
    """Motion T_curr_ref with its covariance (6, 6) [t; r] in curr, and the squared error of each view."""

    T: Array
    covariance: Array
    squared: Array  # (N,) squared Mahalanobis distance
    shared: Array  # (K,) the shared error that was found


def gauss_newton(
    landmarks: Array,
    covariance: Array,
    views: Array,
    T: Array,
    model: StereoModel,
    noise: Array | None = None,
    steps: int = GAUSS_NEWTON_STEPS,
    shared: SharedError | None = None,
    converged: float = CONVERGED,
) -> GaussNewtonResult:
    """Return the motion T_curr_ref (4, 4) that best explains the views (N, 3), from a start T.

    Minimises the sum of rho(e^T S^-1 e) over the bearings of both cameras, rho the Cauchy kernel, S the covariance of
    corner and landmark; noise as in `whitening`. A shared error is estimated along with the motion. A step shorter
    than `converged` [m and rad] is the last one. It replaces eq. (9) of Dang et al. 2012, which measures in 3-D and is
    biased short.
    """
    if shared is None:
        shared = SharedError.none(len(views))
    W = whitening(landmarks, covariance, views, T, model, noise)
    components = len(shared.covariance)
    T, error, squared = np.array(T, order="C"), np.zeros(components), np.empty(len(views))
    spread = np.empty((6 + components, 6 + components))
    prior = np.asarray(np.linalg.inv(shared.covariance), float) if components else shared.covariance
    pose_kernels.gauss_newton(
        landmarks,
        views,
        W,
        np.ascontiguousarray(shared.derivatives),
        prior,
        model.camera,
        steps,
        converged,
        T,
        error,
        spread,
        squared,
    )
    return GaussNewtonResult(T, spread[:6, :6], squared, error)
