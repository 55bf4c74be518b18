"""Compiled Gauss-Newton of the pose: see pose_estimation.py for the method and the meaning of the arguments."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from omnid.core.compiled import compiled, inner

Array = NDArray[np.float64]
Camera = tuple[float, float, float, float, float]

VIEW, POSE, ROTATION = 3, 6, 3  # numbers of a view and of a step, and the first one of its rotation


@compiled(
    "(f8[:, ::1], f8[:, ::1], f8[:, :, ::1], f8[:, :, ::1], UniTuple(f8, 5), f8, f8[:, ::1], f8[::1], f8[::1], "
    "f8[:, ::1], f8[::1])",
    writes=("squared", "H", "g"),
)
def normal_equations(
    landmarks: Array,
    views: Array,
    information: Array,
    derivatives: Array,
    camera: Camera,
    width: float,
    T: Array,
    shared: Array,
    squared: Array,
    H: Array,
    g: Array,
) -> None:
    """Add the views' part of the normal equations H [step; change of the shared error] = g, and write squared errors.

    information (N, 3, 3) [1/px^2] of the views (N, 3) of landmarks (N, 3); derivatives (N, 3, K) of the views by the
    shared error (K,); width: of the Cauchy kernel; T (4, 4): the pose, moved on its left by a step. H (6 + K, 6 + K), g
    (6 + K,), squared (N,).
    """
    size, parts = len(H), range(VIEW)
    J, e, informed, of_a = np.empty((VIEW, size)), np.empty(VIEW), np.empty(VIEW), np.empty(VIEW)
    for n in range(len(landmarks)):
        write_view(landmarks[n], views[n], T, camera, J, e)
        squared[n] = 0.0
        for row in parts:
            for k in range(POSE, size):
                J[row, k] = -derivatives[n, row, k - POSE]
                e[row] += derivatives[n, row, k - POSE] * shared[k - POSE]
        for row in parts:
            informed[row] = 0.0
            for k in parts:
                informed[row] += information[n, row, k] * e[k]
            squared[n] += e[row] * informed[row]
        weight = 1 / (1 + squared[n] / width**2)
        for a in range(size):
            for row in parts:
                g[a] += weight * J[row, a] * informed[row]
                of_a[row] = 0.0
                for k in parts:
                    of_a[row] += weight * information[n, row, k] * J[k, a]
            for b in range(a + 1):
                for row in parts:
                    H[a, b] += of_a[row] * J[row, b]
    for a in range(size):
        for b in range(a):
            H[b, a] = H[a, b]


@inner
def write_view(landmark: Array, seen: Array, T: Array, camera: Camera, J: Array, e: Array) -> None:
    """Write the errors e (3,) [px] of a view of a landmark, and the view's derivatives J (3, 6) by [t; r] left of T.

    The column is f (left - atan2(y, x)) - 1/2, the rows are row0 - f height / r. An upper row that is NaN has no error.
    """
    focal, row0, turn_px, baseline, left = camera
    x, y, z = T[0, -1], T[1, -1], T[2, -1]
    for k in range(len(landmark)):
        x, y, z = x + T[0, k] * landmark[k], y + T[1, k] * landmark[k], z + T[2, k] * landmark[k]
    per_r = 1 / math.sqrt(x * x + y * y)
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
