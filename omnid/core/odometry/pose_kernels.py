"""Compiled Gauss-Newton of the pose: see pose_estimation.py for the method and the meaning of the arguments.

camera: (focal_px, row0, columns of a turn, baseline_m, azimuth of the left edge) of the panoramas.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from omnid.core.compiled import compiled, inner
from omnid.core.odometry.linear_kernels import factorise, solve, write_inverse_cholesky
from omnid.core.odometry.view_kernels import MIN_RADIUS_M, CameraNumbers, linearise, moved

Array = NDArray[np.float64]

# Standard deviations at which the Cauchy kernel halves the weight of an error, so that of normal errors 96 % of the
# efficiency of least squares remains (2.385: 95 %, Holland and Welsch 1977).
KERNEL_WIDTH = 2.5
DAMPING = 1e-9  # added to the normal equations' diagonal, so that few landmarks do not make them singular
SMALL_RAD = 1e-4  # For smaller angles the series of exp is as exact as the formula.


@inner
def robust_weight(squared: float) -> float:
    """Return the weight of a view with a squared Mahalanobis distance: that of the Cauchy kernel.

    Compared with a mixture of two Gaussian distributions in tests/bench/paper/mixture_noise.py.
    """
    return 1 / (1 + squared / KERNEL_WIDTH**2)


@compiled("(f8[:, :], f8[:, :, :], f8[:, :], f8[:, :], UniTuple(f8, 5), f8, f8[:, :, :], f8[:, :, ::1])", writes=("W",))
def whiten(
    landmarks: Array,
    covariance: Array,
    views: Array,
    T: Array,
    camera: CameraNumbers,
    sigma_px: float,
    noise: Array,
    W: Array,
) -> None:
    """Write `pose_estimation.whitening` into W (N, 3, 3); noise (N, 3, 3), or (0, 3, 3) for none."""
    focal, _, _, baseline, _ = camera
    J, S, JR = np.empty((3, 3)), np.empty((3, 3)), np.empty((3, 3))
    for n in range(len(landmarks)):
        x, y, z = moved(T, landmarks[n, 0], landmarks[n, 1], landmarks[n, 2])
        per_r = 1 / max(math.sqrt(x * x + y * y), MIN_RADIUS_M)
        scale = focal * per_r
        J[0, 0], J[0, 1], J[0, 2] = scale * y * per_r, -scale * x * per_r, 0.0
        for row in range(1, 3):
            outward = scale * per_r * per_r * (z if row == 1 else z - baseline)
            J[row, 0], J[row, 1], J[row, 2] = outward * x, outward * y, -scale
        for a in range(3):
            for b in range(3):
                JR[a, b] = J[a, 0] * T[0, b] + J[a, 1] * T[1, b] + J[a, 2] * T[2, b]
        for a in range(3):
            for b in range(a + 1):
                total = sigma_px * sigma_px if a == b else 0.0
                for c in range(3):
                    for d in range(3):
                        total += JR[a, c] * covariance[n, c, d] * JR[b, d]
                if len(noise):
                    total += noise[n, a, b]
                S[a, b] = total
        lower_only = math.isnan(views[n, 2])
        if lower_only:
            S[2, 0], S[2, 1], S[2, 2] = 0.0, 0.0, 1.0
        write_inverse_cholesky(S, W[n])
        if lower_only:
            W[n, 2, 0], W[n, 2, 1], W[n, 2, 2] = 0.0, 0.0, 0.0


@compiled(
    "(f8[:, :], f8[:, :], f8[:, :, ::1], f8[:, :, ::1], f8[:, :], UniTuple(f8, 5), i8, f8, "
    "f8[:, ::1], f8[::1], f8[:, ::1], f8[::1])",
    writes=("T", "error", "inverse", "squared"),
)
def gauss_newton(
    landmarks: Array,
    views: Array,
    W: Array,
    derivatives: Array,
    prior: Array,
    camera: CameraNumbers,
    steps: int,
    converged: float,
    T: Array,
    error: Array,
    inverse: Array,
    squared: Array,
) -> None:
    """Improve the motion T (4, 4) and the shared error (K,); see `pose_estimation.gauss_newton`.

    derivatives (N, 3, K) of the views by the shared error, prior (K, K) the inverse of its covariance. Also writes the
    inverse (6 + K, 6 + K) of the normal equations and the squared errors (N,).
    """
    size = 6 + len(error)
    H, g, step = np.empty((size, size)), np.empty(size), np.empty(size)
    factor = np.empty((size, size))
    accumulate(landmarks, views, W, derivatives, prior, camera, T, error, H, g, squared)
    for _ in range(steps):
        factorise(H, factor)
        solve(factor, g, step)
        left_multiply_exp(step, T)
        largest = 0.0
        for a in range(6):
            largest = max(largest, abs(step[a]))
        for a in range(6, size):
            error[a - 6] += step[a]
        if largest < converged:
            break  # the last equations hold here as well
        accumulate(landmarks, views, W, derivatives, prior, camera, T, error, H, g, squared)
    factorise(H, factor)
    for a in range(size):
        for b in range(size):
            g[b] = 1.0 if a == b else 0.0
        solve(factor, g, inverse[a])


@inner
def apply_whitening(W: Array, J: Array, e: Array, J_white: Array, e_white: Array) -> float:
    """Write W J (3, K) and W e (3,), W a lower triangle; return the squared length of W e."""
    total = 0.0
    for row in range(3):
        e_white[row] = 0.0
        for inner_row in range(row + 1):
            e_white[row] += W[row, inner_row] * e[inner_row]
        for k in range(J.shape[1]):
            J_white[row, k] = W[row, 0] * J[0, k]
        for inner_row in range(1, row + 1):
            for k in range(J.shape[1]):
                J_white[row, k] += W[row, inner_row] * J[inner_row, k]
        total += e_white[row] * e_white[row]
    return total


@inner
def accumulate(
    landmarks: Array,
    views: Array,
    W: Array,
    derivatives: Array,
    prior: Array,
    camera: CameraNumbers,
    T: Array,
    error: Array,
    H: Array,
    g: Array,
    squared: Array,
) -> None:
    """Write the normal equations H [step; change] = g, and the squared errors (N,) of the views.

    step: [t; r] on the left of T; change (K,): of the shared error.
    """
    size = len(g)
    for a in range(size):
        g[a] = 0.0
        for b in range(size):
            H[a, b] = 0.0
    J, e, J_white, e_white = np.empty((3, size)), np.empty(3), np.empty((3, size)), np.empty(3)
    for n in range(len(landmarks)):
        linearise(landmarks[n], views[n], camera, T, J, e)
        for k in range(6, size):
            for row in range(3):
                J[row, k] = -derivatives[n, row, k - 6]
                e[row] += derivatives[n, row, k - 6] * error[k - 6]
        squared[n] = apply_whitening(W[n], J, e, J_white, e_white)
        weight = robust_weight(squared[n])
        for row in range(3):
            for a in range(size):
                weighted = weight * J_white[row, a]
                g[a] += weighted * e_white[row]
                for b in range(a + 1):
                    H[a, b] += weighted * J_white[row, b]
    for a in range(size):
        H[a, a] += DAMPING
        for b in range(a):
            H[b, a] = H[a, b]
    for a in range(6, size):
        for b in range(6, size):
            H[a, b] += prior[a - 6, b - 6]
            g[a] -= prior[a - 6, b - 6] * error[b - 6]


@inner
def left_multiply_exp(twist: Array, T: Array) -> None:
    """Replace T (4, 4) by exp(twist) T; twist (6,) or more: [translation; rotation vector], as `se3.exp`."""
    wx, wy, wz = twist[3], twist[4], twist[5]
    angle2 = wx * wx + wy * wy + wz * wz
    angle = math.sqrt(angle2)
    if angle < SMALL_RAD:
        a, b, c = 1 - angle2 / 6, 0.5 - angle2 / 24, 1 / 6 - angle2 / 120
    else:
        a, b = math.sin(angle) / angle, 2 * (math.sin(angle / 2) / angle) ** 2
        c = (angle - math.sin(angle)) / (angle2 * angle)
    W, R, V, before = np.empty((3, 3)), np.empty((3, 3)), np.empty((3, 3)), np.empty((3, 4))
    W[0, 0], W[1, 1], W[2, 2] = 0.0, 0.0, 0.0
    W[0, 1], W[0, 2], W[1, 2] = -wz, wy, -wx
    W[1, 0], W[2, 0], W[2, 1] = wz, -wy, wx
    for i in range(3):
        for j in range(4):
            before[i, j] = T[i, j]
        for j in range(3):
            square = W[i, 0] * W[0, j] + W[i, 1] * W[1, j] + W[i, 2] * W[2, j]
            one = 1.0 if i == j else 0.0
            R[i, j], V[i, j] = one + a * W[i, j] + b * square, one + b * W[i, j] + c * square
    for i in range(3):
        for j in range(4):
            T[i, j] = R[i, 0] * before[0, j] + R[i, 1] * before[1, j] + R[i, 2] * before[2, j]
        T[i, 3] += V[i, 0] * twist[0] + V[i, 1] * twist[1] + V[i, 2] * twist[2]
