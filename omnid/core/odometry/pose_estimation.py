"""Motion from landmarks and their views in both cameras: RANSAC on three points, then Gauss-Newton."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from calib import se3
from calib.panorama import Cylinder
from omnid.core.stereo.triangulation import MIN_RADIUS_M, triangulate, view, view_jacobian

Array = NDArray[np.float64]
Flags = NDArray[np.bool_]

RANSAC_BATCH, RANSAC_BATCHES = 12, 40  # hypotheses drawn at once, and how often at most
RANSAC_THRESHOLD_PX = 2.0  # largest error of a view in the consensus set
RANSAC_MISSED = 1e-6  # probability that no hypothesis was free of outliers, at which the search ends
KERNEL_WIDTH = 2.5  # standard deviations at which the Cauchy kernel halves the weight of an error
GAUSS_NEWTON_STEPS = 6  # at most
CONVERGED = 1e-5  # m and rad: a smaller step is the last one
DAMPING = 1e-9  # added to the normal equations' diagonal, so that few landmarks do not make them singular


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


@dataclass(frozen=True, slots=True)
class StereoModel:
    """Projection of points into views: the panorama's cylinder, the baseline, and the noise of a tracked corner."""

    cylinder: Cylinder
    baseline_m: float
    sigma_px: float = 0.1  # standard deviation

    def residual(self, points: Array, views: Array) -> Array:
        """Return views minus predictions (..., N, 3) [px], columns wrapped; views (N, 3), NaN without an upper row."""
        flat = points.reshape(-1, 3)
        error = views - view(flat, self.cylinder, self.baseline_m).reshape(points.shape)
        error[..., 0] = self.cylinder.wrap(error[..., 0])
        return error


def rigid_fit(a: Array, b: Array) -> Array:
    """Return T_b_a (..., 4, 4) that moves points a (..., N, 3) onto b with least squares (Kabsch), no reflection."""
    mean_a, mean_b = a.mean(axis=-2, keepdims=True), b.mean(axis=-2, keepdims=True)
    U, _, Vt = np.linalg.svd(np.swapaxes(b - mean_b, -1, -2) @ (a - mean_a))
    U[..., :, 2] *= np.sign(np.linalg.det(U) * np.linalg.det(Vt))[..., None]
    R = U @ Vt
    return se3.transform(R, (mean_b[..., 0, :, None] - R @ mean_a[..., 0, :, None])[..., 0])


def ransac(landmarks: Array, views: Array, model: StereoModel, rng: np.random.Generator,
           threshold_px: float = RANSAC_THRESHOLD_PX) -> tuple[Array, Flags]:
    """Return the motion T_curr_ref with the largest consensus set of landmarks (N, 3), and the set's flags (N,).

    Three of the points seen in both cameras give a hypothesis; the errors of the views [px] give its consensus set:
    Dang et al. 2012, section IV.B, with the distance measured in the images, where the noise is even. Hypotheses are
    drawn in batches until three inliers have almost certainly been among them.
    """
    seen = triangulate(views, model.cylinder, model.baseline_m)
    usable = np.flatnonzero(np.isfinite(seen).all(axis=1))
    if len(usable) < 3:
        return np.eye(4), np.zeros(len(landmarks), bool)
    best, consensus = np.eye(4), np.zeros(len(landmarks), bool)
    for batch in range(1, RANSAC_BATCHES + 1):
        triples = usable[rng.random((RANSAC_BATCH, len(usable))).argpartition(2, axis=1)[:, :3]]
        motions = rigid_fit(landmarks[triples], seen[triples])
        errors = model.residual(se3.apply(motions, landmarks), views)
        agree = np.nanmax(np.abs(errors), axis=-1) < threshold_px
        first = int(agree.sum(axis=1).argmax())
        if agree[first].sum() > consensus.sum():
            best, consensus = motions[first], agree[first]
        if (1 - consensus.mean() ** 3) ** (batch * RANSAC_BATCH) < RANSAC_MISSED:
            break
    return best, consensus


def whitening(landmarks: Array, covariance: Array, views: Array, T: Array, model: StereoModel,
              noise: Array | None = None) -> Array:
    """Return W (N, 3, 3) with W S W^T = I for the covariance S of each view's error: corner and landmark noise.

    noise: covariance (N, 3, 3) [px^2] of the views beside sigma_px; None: none.
    A view without the upper row (NaN) gets a row of zeros there.
    """
    J = view_jacobian(se3.apply(T, landmarks), model.cylinder, model.baseline_m) @ T[:3, :3]
    S = J @ covariance @ np.swapaxes(J, -1, -2) + model.sigma_px**2 * np.eye(3) + (0.0 if noise is None else noise)
    lower_only = np.isnan(views[:, 2])
    S[lower_only, 2, :], S[lower_only, :, 2] = 0.0, 0.0
    S[lower_only, 2, 2] = 1.0
    W = _inverse_cholesky(S)
    W[lower_only, 2, :] = 0.0
    return W


def _inverse_cholesky(S: Array) -> Array:
    """Return the inverses (N, 3, 3) of the lower Cholesky factors of S (N, 3, 3), which is positive definite.

    Written out, because numpy's loops over small matrices take ten times as long.
    """
    W = np.zeros(S.shape)
    l00 = np.sqrt(S[:, 0, 0])
    l10, l20 = S[:, 1, 0] / l00, S[:, 2, 0] / l00
    l11 = np.sqrt(S[:, 1, 1] - l10 * l10)
    l21 = (S[:, 2, 1] - l20 * l10) / l11
    l22 = np.sqrt(S[:, 2, 2] - l20 * l20 - l21 * l21)
    W[:, 0, 0], W[:, 1, 1], W[:, 2, 2] = 1 / l00, 1 / l11, 1 / l22
    W[:, 1, 0] = -l10 * W[:, 0, 0] * W[:, 1, 1]
    W[:, 2, 1] = -l21 * W[:, 1, 1] * W[:, 2, 2]
    W[:, 2, 0] = -(l20 * W[:, 0, 0] + l21 * W[:, 1, 0]) * W[:, 2, 2]
    return W


@dataclass(frozen=True, slots=True)
class GaussNewtonResult:
    """Motion T_curr_ref with its covariance (6, 6) [t; r] in curr, and the squared error of each view."""

    T: Array
    covariance: Array
    squared: Array  # (N,) squared Mahalanobis distance
    shared: Array  # (K,) the shared error that was found
    shared_covariance: Array  # (K, K)


def gauss_newton(landmarks: Array, covariance: Array, views: Array, T: Array, model: StereoModel,
                 noise: Array | None = None, steps: int = GAUSS_NEWTON_STEPS, shared: SharedError | None = None,
                 converged: float = CONVERGED) -> GaussNewtonResult:
    """Return the motion T_curr_ref (4, 4) that best explains the views (N, 3), from a start T.

    Minimises the sum of rho(e^T S^-1 e) over the bearings of both cameras, rho the Cauchy kernel, S the covariance of
    corner and landmark; noise as in `whitening`. A shared error is estimated along with the motion. A step shorter
    than `converged` [m and rad] is the last one. It replaces eq. (9) of Dang et al. 2012, which measures in 3-D and is
    biased short.
    """
    if shared is None:
        shared = SharedError.none(len(views))
    W = whitening(landmarks, covariance, views, T, model, noise)
    equations = _PoseEquations(landmarks, np.where(np.isnan(views), 0.0, views), W, model, shared)
    error = np.zeros(len(shared.covariance))
    H, g, squared = equations.at(T, error)
    for _ in range(steps):
        step = np.linalg.solve(H, g)
        T, error = se3.exp(step[:6]) @ T, error + step[6:]
        if np.abs(step[:6]).max() < converged:
            break  # the last equations hold here as well
        H, g, squared = equations.at(T, error)
    spread = np.asarray(np.linalg.inv(H), float)
    return GaussNewtonResult(T, spread[:6, :6], squared, error, spread[6:, 6:])


def robust_weight(squared: Array) -> Array:
    """Return the weights (N,) of views with squared Mahalanobis distances (N,): those of the Cauchy kernel.

    Compared with a mixture of two Gaussian distributions in tests/experiments/mixture_noise.py.
    """
    return 1 / (1 + squared / KERNEL_WIDTH**2)


class _PoseEquations:
    """Normal equations of N views. Arrays are kept as rows of N values, over which numpy loops fastest."""

    def __init__(self, landmarks: Array, views: Array, W: Array, model: StereoModel, shared: SharedError) -> None:
        self._landmarks, self._views = np.ascontiguousarray(landmarks.T), np.ascontiguousarray(views.T)
        self._W = np.ascontiguousarray(W.transpose(1, 2, 0))  # (3, 3, N)
        self._model = model
        self._by_error = (-W @ shared.derivatives).transpose(2, 1, 0)  # (K, 3, N)
        self._prior = np.linalg.inv(shared.covariance)

    def at(self, T: Array, error: Array) -> tuple[Array, Array, Array]:
        """Return H, g of H [step; change] = g, and the squared errors (N,) of the views.

        step: [t; r] on the left of T; change (K,): of the shared error (K,).
        """
        J = np.zeros((7 + len(error), 3, self._views.shape[1]))
        self._linearise(T[:3, :3] @ self._landmarks + T[:3, 3:], J)
        # Whitening, in place: W is a lower triangle.
        W = self._W
        J[:7, 2] = W[2, 0] * J[:7, 0] + W[2, 1] * J[:7, 1] + W[2, 2] * J[:7, 2]
        J[:7, 1] = W[1, 0] * J[:7, 0] + W[1, 1] * J[:7, 1]
        J[:7, 0] *= W[0, 0]
        J[7:] = self._by_error
        residual = J[0] - np.tensordot(error, self._by_error, 1) if len(error) else J[0]
        squared = (residual**2).sum(axis=0)
        weight = robust_weight(squared)
        flat, weighted = J[1:].reshape(len(J) - 1, -1), (J[1:] * weight).reshape(len(J) - 1, -1)
        H, g = weighted @ flat.T + DAMPING * np.eye(len(flat)), weighted @ residual.ravel()
        H[6:, 6:] += self._prior
        g[6:] -= self._prior @ error
        return H, g, squared

    def _linearise(self, points: Array, into: Array) -> None:
        """Write the residuals (3, N) of the views of points (3, N), and the derivatives (6, 3, N) by [t; r]."""
        x, y, z = points
        cylinder, baseline_m = self._model.cylinder, self._model.baseline_m
        f, per_r = cylinder.focal_px, 1.0 / np.maximum(np.sqrt(x * x + y * y), MIN_RADIUS_M)
        along_x, along_y, scale = x * per_r, y * per_r, f * per_r
        column = (math.pi - np.arctan2(y, x)) * f - 0.5
        lower = cylinder.row0 - scale * z
        into[0, 0] = cylinder.wrap(self._views[0] - column)
        into[0, 1] = self._views[1] - lower
        into[0, 2] = self._views[2] - lower - scale * baseline_m
        # Column: f (pi - atan2(y, x)); its derivative by a turn about z is -f.
        into[1, 0], into[2, 0] = scale * along_y, -scale * along_x
        into[4, 0], into[5, 0], into[6, 0] = -z * into[2, 0], z * into[1, 0], -f
        # Rows: row0 - f height / r; a turn about z does not change them.
        for row, height in ((1, z), (2, z - baseline_m)):
            outward = scale * per_r * height
            into[1, row], into[2, row], into[3, row] = outward * along_x, outward * along_y, -scale
            into[4, row] = y * into[3, row] - z * into[2, row]
            into[5, row] = z * into[1, row] - x * into[3, row]
