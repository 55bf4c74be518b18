"""Compiled Gauss-Newton of the pose: see pose_estimation.py for the method and the meaning of the arguments."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from omnid.core.compiled import compiled, inner
from omnid.core.odometry.patch_kernels import invert

Array = NDArray[np.float64]
Camera = tuple[float, float, float, float, float]

VIEW, POSE, ROTATION = 3, 6, 3  # numbers of a view and of a step, and the first one of its rotation
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
    size, parts = len(inverse), range(VIEW)
    J, e, informed, of_a, step = np.empty((VIEW, size)), np.empty(VIEW), np.empty(VIEW), np.empty(VIEW), np.empty(size)
    g, by_landmark, of_landmark = np.empty(size), np.empty((VIEW, VIEW)), np.empty((VIEW, VIEW))
    # 1. The information of the views, at the start. An upper row that is not known has none.
    for n in range(len(landmarks)):
        write_view(landmarks[n], views[n], T, camera, J, e)
        for a in parts:
            for b in parts:
                by_landmark[a, b] = J[a, 0] * T[0, b] + J[a, 1] * T[1, b] + J[a, 2] * T[2, b]
        for a in parts:
            for b in parts:
                of_landmark[a, b] = 0.0
                for c in parts:
                    of_landmark[a, b] += by_landmark[a, c] * covariance[n, c, b]
        for a in parts:
            for b in parts:
                for c in parts:
                    S[n, a, b] += of_landmark[a, c] * by_landmark[b, c]
        if math.isnan(views[n, 2]):
            S[n, 2, :2], S[n, :2, 2], S[n, 2, 2] = 0.0, 0.0, math.inf
        invert(S[n])
    for number in range(steps + 1):
        # 2. The normal equations H [step; change] = g at the pose, and the squared errors of the views.
        inverse[:] = prior
        for a in range(size):
            g[a] = 0.0
            for b in range(POSE, size):
                g[a] -= prior[a, b] * shared[b - POSE]
        for n in range(len(landmarks)):
            write_view(landmarks[n], views[n], T, camera, J, e)
            squared[n] = 0.0
            for row in parts:
                for k in range(POSE, size):
                    J[row, k] = -derivatives[n, row, k - POSE]
                    e[row] += derivatives[n, row, k - POSE] * shared[k - POSE]
            for row in parts:
                informed[row] = S[n, row, 0] * e[0] + S[n, row, 1] * e[1] + S[n, row, 2] * e[2]
                squared[n] += e[row] * informed[row]
            weight = 1 / (1 + squared[n] / width**2)
            for a in range(size):
                g[a] += weight * (J[0, a] * informed[0] + J[1, a] * informed[1] + J[2, a] * informed[2])
                for row in parts:
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
        for a in range(size):
            step[a] = 0.0
            for b in range(size):
                step[a] += inverse[a, b] * g[b]
        for k in range(POSE, size):
            shared[k - POSE] += step[k]
        move(T, step[:ROTATION], step[ROTATION:POSE])
        if np.abs(step[:POSE]).max() < converged:
            break


@inner
def write_view(landmark: Array, seen: Array, T: Array, camera: Camera, J: Array, e: Array) -> None:
    """Write the errors e (3,) [px] of a view of a landmark, and the view's derivatives J (3, 6) by [t; r] left of T.

    The column is f (left - atan2(y, x)) - 1/2, the rows are row0 - f height / r. An upper row that is NaN has no error.
    """
    focal, row0, turn_px, baseline, left = camera
    x, y, z = T[0, -1], T[1, -1], T[2, -1]
    for k in range(len(landmark)):
        x, y, z = x + T[0, k] * landmark[k], y + T[1, k] * landmark[k], z + T[2, k] * landmark[k]
    per_r = 1 / max(math.sqrt(x * x + y * y), LEAST_R_M)
    scale = focal * per_r
    column_error = seen[0] - (left - math.atan2(y, x)) * focal + 0.5
    e[0] = column_error - turn_px * math.floor(column_error / turn_px + 0.5)
    J[0, 0], J[0, 1], J[0, 2] = scale * y * per_r, -scale * x * per_r, 0.0
    for row in range(1, len(e)):
        height = z if row == 1 else z - baseline
        e[row] = 0.0 if math.isnan(seen[row]) else seen[row] - row0 + scale * height
        outward = scale * per_r * per_r * height
        J[row, 0], J[row, 1], J[row, 2] = outward * x, outward * y, -scale
    # A turn moves the point by r x p.
    for row in range(len(e)):
        by_x, by_y, by_z = J[row, 0], J[row, 1], J[row, 2]
        J[row, ROTATION], J[row, ROTATION + 1], J[row, ROTATION + 2] = (
            y * by_z - z * by_y,
            z * by_x - x * by_z,
            x * by_y - y * by_x,
        )


@inner
def move(T: Array, t: Array, r: Array) -> None:
    """Replace T (4, 4) by exp([t; r]) T (Rodrigues)."""
    squared = r[0] * r[0] + r[1] * r[1] + r[2] * r[2]
    angle = math.sqrt(squared)
    # sin(a) / a, (1 - cos(a)) / a^2, (a - sin(a)) / a^3
    a, b, c = 1 - squared / 6, 0.5 - squared / 24, 1 / 6 - squared / 120
    if angle > SMALL_RAD:
        a, b, c = math.sin(angle) / angle, (1 - math.cos(angle)) / squared, (angle - math.sin(angle)) / angle / squared
    before, parts = T.copy(), range(len(r))
    for i in parts:
        T[i, -1] = t[i]
        for k in range(len(T)):
            T[i, k] = 0.0 if k < len(r) else t[i]
        for j in parts:
            # W = [r]x, W^2 = r r^T - |r|^2 I.
            k = len(r) - i - j
            W = 0.0 if i == j else (r[k] if (j - i) % len(r) == 2 else -r[k])
            WW = r[i] * r[j] - (squared if i == j else 0.0)
            R = (1.0 if i == j else 0.0) + a * W + b * WW
            T[i, -1] += (b * W + c * WW) * t[j]
            for k in range(len(T)):
                T[i, k] += R * before[j, k]
