"""Compiled part of the store of landmarks: see landmarks.py."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from omnid.core.compiled import compiled, inner
from omnid.core.odometry.view_kernels import MIN_RADIUS_M, CameraNumbers, moved

Array = NDArray[np.float64]
Indices = NDArray[np.intp]

CORRELATED_FRAMES = 4.0  # frames whose disparities of one landmark count as one.
OUTLIER_SQUARED = 9.0  # squared distance (3 sigma) from which a disparity is not used, so that 0.3 % of right ones are


@compiled(
    "(i8[:], f8[:], f8[:], i8[:], f8[:, :, ::1], f8[:, :, ::1], UniTuple(f8, 5), f8, "
    "f8[:, ::1], f8[:, :, ::1], f8[:, ::1], f8[:, :, ::1])",
    writes=("points", "covariance", "in_odom", "covariance_in_odom"),
)
def update_depths(
    rows: Indices,
    disparity: Array,
    variance: Array,
    keyframe: Indices,
    T_curr_keyframe: Array,
    T_odom_keyframe: Array,
    camera: CameraNumbers,
    sigma_px: float,
    points: Array,
    covariance: Array,
    in_odom: Array,
    covariance_in_odom: Array,
) -> None:
    """Correct the landmarks' points and covariances by disparities: see `LandmarkStore.update_depths`.

    keyframe (M,): index of the anchor of each of the rows into the transforms (K, 4, 4). points (N, 3) and covariance
    (N, 3, 3) are in the anchors.
    """
    focal, _, _, baseline, _ = camera
    H, PH = np.empty(3), np.empty(3)
    for m in range(len(rows)):
        if math.isnan(disparity[m]):
            continue
        n, T = rows[m], T_curr_keyframe[keyframe[m]]
        P = covariance[n]
        x, y, _ = moved(T, points[n, 0], points[n, 1], points[n, 2])
        r = max(math.sqrt(x * x + y * y), MIN_RADIUS_M)
        predicted = focal * baseline / r
        # The disparity is f t / r, which does not depend on z.
        of_x, of_y = -predicted * x / (r * r), -predicted * y / (r * r)
        variance_of = CORRELATED_FRAMES * (variance[m] + 2 * sigma_px * sigma_px)
        for a in range(3):
            H[a] = of_x * T[0, a] + of_y * T[1, a]
        for a in range(3):
            PH[a] = P[a, 0] * H[0] + P[a, 1] * H[1] + P[a, 2] * H[2]
        S = H[0] * PH[0] + H[1] * PH[1] + H[2] * PH[2] + variance_of
        innovation = disparity[m] - predicted
        if not innovation * innovation < OUTLIER_SQUARED * S:
            continue
        for a in range(3):
            points[n, a] += PH[a] * innovation / S
            for b in range(3):
                P[a, b] -= PH[a] * PH[b] / S
        place(points[n], P, T_odom_keyframe[keyframe[m]], in_odom[n], covariance_in_odom[n])


@compiled("(f8[:, ::1], f8[:, :, ::1], f8[:, :], f8[:, ::1], f8[:, :, ::1])", writes=("in_odom", "covariance_in_odom"))
def place_all(
    points: Array, covariance: Array, T_odom_keyframe: Array, in_odom: Array, covariance_in_odom: Array
) -> None:
    """Write points (N, 3) [m] and covariances (N, 3, 3) [m^2] of a keyframe's rectified frame in odom."""
    for n in range(len(points)):
        place(points[n], covariance[n], T_odom_keyframe, in_odom[n], covariance_in_odom[n])


@inner
def place(point: Array, P: Array, T: Array, moved_point: Array, moved_P: Array) -> None:
    """Write a point (3,) and its covariance (3, 3) in the frame into which T leads."""
    moved_point[0], moved_point[1], moved_point[2] = moved(T, point[0], point[1], point[2])
    for a in range(3):
        for b in range(a + 1):
            total = 0.0
            for c in range(3):
                for d in range(3):
                    total += T[a, c] * P[c, d] * T[b, d]
            moved_P[a, b] = moved_P[b, a] = total
