"""Compiled normal equations of the pose: see pose_estimation.py for the method and the meaning of the arguments."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from omnid.core.compiled import compiled

Array = NDArray[np.float64]


@compiled(
    "(f8[:, :], f8[:, :], f8[:, :, :], f8[:, :, :], UniTuple(f8, 5), f8[:, :], f8[:], f8, "
    "f8[:, ::1], f8[::1], f8[::1])",
    writes=("H", "g", "squared"),
)
def normal_equations(
    landmarks: Array,
    views: Array,
    P: Array,
    derivatives: Array,
    camera: tuple[float, float, float, float, float],
    T: Array,
    shared: Array,
    width: float,
    H: Array,
    g: Array,
    squared: Array,
) -> None:
    """Write H (6 + K, 6 + K) and g (6 + K,) of H [step; change] = g, and the squared errors (N,) of the views.

    step: [t; r] on the left of T (4, 4); change: of the shared error (K,), by which the derivatives (N, 3, K) of the
    views are taken. P (N, 3, 3) [1/px^2]: information of the views. width: of the Cauchy kernel.
    """
    focal, row0, turn_px, baseline, left = camera
    size = len(g)
    J, e, informed, of_a = np.empty((3, size)), np.empty(3), np.empty(3), np.empty(3)
    H[:], g[:] = 0.0, 0.0
    for n in range(len(landmarks)):
        # 1. The point, and the error of its view: column f (left - atan2(y, x)), rows row0 - f height / r.
        x = T[0, 0] * landmarks[n, 0] + T[0, 1] * landmarks[n, 1] + T[0, 2] * landmarks[n, 2] + T[0, 3]
        y = T[1, 0] * landmarks[n, 0] + T[1, 1] * landmarks[n, 1] + T[1, 2] * landmarks[n, 2] + T[1, 3]
        z = T[2, 0] * landmarks[n, 0] + T[2, 1] * landmarks[n, 1] + T[2, 2] * landmarks[n, 2] + T[2, 3]
        per_r = 1 / max(math.sqrt(x * x + y * y), 1e-9)
        scale = focal * per_r
        column_error = views[n, 0] - (left - math.atan2(y, x)) * focal + 0.5
        e[0] = column_error - turn_px * math.floor(column_error / turn_px + 0.5)
        e[1] = views[n, 1] - row0 + scale * z
        e[2] = 0.0 if math.isnan(views[n, 2]) else views[n, 2] - row0 + scale * (z - baseline)
        # 2. Its derivatives by [t; r] and by the shared error. A turn about z does not change the rows.
        J[0, 0], J[0, 1], J[0, 2] = scale * y * per_r, -scale * x * per_r, 0.0
        J[0, 3], J[0, 4], J[0, 5] = -z * J[0, 1], z * J[0, 0], -focal
        for row in range(1, 3):
            outward = scale * per_r * per_r * (z if row == 1 else z - baseline)
            J[row, 0], J[row, 1], J[row, 2] = outward * x, outward * y, -scale
            J[row, 3], J[row, 4] = y * J[row, 2] - z * J[row, 1], z * J[row, 0] - x * J[row, 2]
            J[row, 5] = 0.0
        for row in range(3):
            for k in range(6, size):
                J[row, k] = -derivatives[n, row, k - 6]
                e[row] += derivatives[n, row, k - 6] * shared[k - 6]
        # 3. The squared error, and the sums with the weight of the Cauchy kernel.
        squared[n] = 0.0
        for row in range(3):
            informed[row] = P[n, row, 0] * e[0] + P[n, row, 1] * e[1] + P[n, row, 2] * e[2]
            squared[n] += e[row] * informed[row]
        weight = 1 / (1 + squared[n] / width**2)
        for a in range(size):
            g[a] += weight * (J[0, a] * informed[0] + J[1, a] * informed[1] + J[2, a] * informed[2])
            for row in range(3):
                of_a[row] = weight * (P[n, row, 0] * J[0, a] + P[n, row, 1] * J[1, a] + P[n, row, 2] * J[2, a])
            for b in range(a + 1):
                H[a, b] += of_a[0] * J[0, b] + of_a[1] * J[1, b] + of_a[2] * J[2, b]
    for a in range(size):
        for b in range(a):
            H[b, a] = H[a, b]
