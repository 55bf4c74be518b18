"""Compiled Gauss-Newton of the pose: see pose_estimation.py for the method and the meaning of the arguments."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from omnid.core.compiled import compiled, inner
from omnid.core.odometry.patch_kernels import invert

Array = NDArray[np.float64]
Camera = tuple[float, float, float, float, float]

LEAST_R_M = 1e-9  # from the axis, so that no division is by zero
SMALL_RAD = 1e-4  # below which the series of a rotation are exact to rounding


@compiled(
    "(f8[:, ::1], f8[:, :, ::1], f8[:, ::1], f8[:, :, ::1], f8[:, :, ::1], f8[:, ::1], UniTuple(f8, 5), f8, i8, f8, "
    "f8[:, ::1], f8[::1], f8[::1], f8[:, ::1])",
    writes=("S", "T", "shared", "squared", "inverse"),
)
def solve(
    landmarks: Array,
    covariance: Array,
    views: Array,
    S: Array,
    derivatives: Array,
    prior: Array,
    camera: Camera,
    width: float,
    steps: int,
    converged: float,
    T: Array,
    shared: Array,
    squared: Array,
    inverse: Array,
) -> None:
    """Improve T (4, 4) and the shared error (K,) by steps of Gauss-Newton, until one is short.

    covariance (N, 3, 3) [m^2] of the landmarks (N, 3); S (N, 3, 3) [px^2] of the views' noise, becomes their
    information; derivatives (N, 3, K) of the views by the shared error; prior (6 + K, 6 + K): information of [step;
    shared error]; width: of the Cauchy kernel. Also writes the squared errors (N,) of the views, and the inverse
    (6 + K, 6 + K) of the last normal equations.
    """
    size = len(inverse)
    J, e, informed, of_a, step = np.empty((3, size)), np.empty(3), np.empty(3), np.empty(3), np.empty(size)
    g, by_landmark, of_landmark = np.empty(size), np.empty((3, 3)), np.empty((3, 3))
    # 1. The information of the views, at the start. An upper row that is not known has none.
    for n in range(len(landmarks)):
        write_view(landmarks[n], views[n], T, camera, J, e)
        for a in range(3):
            for b in range(3):
                by_landmark[a, b] = J[a, 0] * T[0, b] + J[a, 1] * T[1, b] + J[a, 2] * T[2, b]
        for a in range(3):
            for b in range(3):
                of_landmark[a, b] = 0.0
                for c in range(3):
                    of_landmark[a, b] += by_landmark[a, c] * covariance[n, c, b]
        for a in range(3):
            for b in range(3):
                for c in range(3):
                    S[n, a, b] += of_landmark[a, c] * by_landmark[b, c]
        if math.isnan(views[n, 2]):
            S[n, 2, :2], S[n, :2, 2], S[n, 2, 2] = 0.0, 0.0, math.inf
        invert(S[n])
    for number in range(steps + 1):
        # 2. The normal equations H [step; change] = g at the pose, and the squared errors of the views.
        inverse[:] = prior
        for a in range(size):
            g[a] = 0.0
            for b in range(6, size):
                g[a] -= prior[a, b] * shared[b - 6]
        for n in range(len(landmarks)):
            write_view(landmarks[n], views[n], T, camera, J, e)
            for row in range(3):
                for k in range(6, size):
                    J[row, k] = -derivatives[n, row, k - 6]
                    e[row] += derivatives[n, row, k - 6] * shared[k - 6]
            squared[n] = 0.0
            for row in range(3):
                informed[row] = S[n, row, 0] * e[0] + S[n, row, 1] * e[1] + S[n, row, 2] * e[2]
                squared[n] += e[row] * informed[row]
            weight = 1 / (1 + squared[n] / width**2)
            for a in range(size):
                g[a] += weight * (J[0, a] * informed[0] + J[1, a] * informed[1] + J[2, a] * informed[2])
                for row in range(3):
                    of_a[row] = weight * (S[n, row, 0] * J[0, a] + S[n, row, 1] * J[1, a] + S[n, row, 2] * J[2, a])
                for b in range(a + 1):
                    inverse[a, b] += of_a[0] * J[0, b] + of_a[1] * J[1, b] + of_a[2] * J[2, b]
        for a in range(size):
            for b in range(a):
                inverse[b, a] = inverse[a, b]
        invert(inverse)
        if number == steps:
            break
        # 3. The step. If it is short, the last equations hold after it as well.
        longest = 0.0
        for a in range(size):
            step[a] = 0.0
            for b in range(size):
                step[a] += inverse[a, b] * g[b]
            if a < 6:
                longest = max(longest, abs(step[a]))
            else:
                shared[a - 6] += step[a]
        move(T, step)
        if longest < converged:
            break


@inner
def write_view(landmark: Array, seen: Array, T: Array, camera: Camera, J: Array, e: Array) -> None:
    """Write the errors e (3,) [px] of a view of a landmark, and the view's derivatives J (3, 6) by [t; r] left of T.

    The column is f (left - atan2(y, x)) - 1/2, the rows are row0 - f height / r. An upper row that is NaN has no error.
    """
    focal, row0, turn_px, baseline, left = camera
    x = T[0, 0] * landmark[0] + T[0, 1] * landmark[1] + T[0, 2] * landmark[2] + T[0, 3]
    y = T[1, 0] * landmark[0] + T[1, 1] * landmark[1] + T[1, 2] * landmark[2] + T[1, 3]
    z = T[2, 0] * landmark[0] + T[2, 1] * landmark[1] + T[2, 2] * landmark[2] + T[2, 3]
    per_r = 1 / max(math.sqrt(x * x + y * y), LEAST_R_M)
    scale = focal * per_r
    column_error = seen[0] - (left - math.atan2(y, x)) * focal + 0.5
    e[0] = column_error - turn_px * math.floor(column_error / turn_px + 0.5)
    e[1] = seen[1] - row0 + scale * z
    e[2] = 0.0 if math.isnan(seen[2]) else seen[2] - row0 + scale * (z - baseline)
    # A turn about z does not change the rows.
    J[0, 0], J[0, 1], J[0, 2] = scale * y * per_r, -scale * x * per_r, 0.0
    J[0, 3], J[0, 4], J[0, 5] = -z * J[0, 1], z * J[0, 0], -focal
    for row in range(1, 3):
        outward = scale * per_r * per_r * (z if row == 1 else z - baseline)
        J[row, 0], J[row, 1], J[row, 2] = outward * x, outward * y, -scale
        J[row, 3], J[row, 4] = y * J[row, 2] - z * J[row, 1], z * J[row, 0] - x * J[row, 2]
        J[row, 5] = 0.0


@inner
def move(T: Array, step: Array) -> None:
    """Replace T (4, 4) by exp(step) T, for a step (6 or more) = [t; r]."""
    # 1. Rotation and translation of the step (Rodrigues), W the cross product with r.
    squared = step[3] ** 2 + step[4] ** 2 + step[5] ** 2
    angle = math.sqrt(squared)
    if angle < SMALL_RAD:
        a, b, c = 1 - squared / 6, 0.5 - squared / 24, 1 / 6 - squared / 120
    else:
        a, b, c = math.sin(angle) / angle, (1 - math.cos(angle)) / squared, (angle - math.sin(angle)) / angle / squared
    W = np.array([[0.0, -step[5], step[4]], [step[5], 0.0, -step[3]], [-step[4], step[3], 0.0]])
    R, before = np.empty((3, 3)), T.copy()
    for i in range(3):
        T[i, 3] = step[i]
        for j in range(3):
            # W^2 = r r^T - |r|^2 I.
            WW = step[3 + i] * step[3 + j] - (squared if i == j else 0.0)
            R[i, j] = (1.0 if i == j else 0.0) + a * W[i, j] + b * WW
            T[i, 3] += (b * W[i, j] + c * WW) * step[j]
    # 2. The product.
    for i in range(3):
        for j in range(3):
            T[i, j] = R[i, 0] * before[0, j] + R[i, 1] * before[1, j] + R[i, 2] * before[2, j]
        T[i, 3] += R[i, 0] * before[0, 3] + R[i, 1] * before[1, 3] + R[i, 2] * before[2, 3]
