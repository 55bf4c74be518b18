"""Compiled view of a landmark in both panoramas, and its derivatives.

camera: (focal_px, row0, columns of a turn, baseline_m, azimuth of the left edge) of the panoramas.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from omnid.core.compiled import inner

Array = NDArray[np.float64]
CameraNumbers = tuple[float, float, float, float, float]

MIN_RADIUS_M = 1e-9  # Distance from the axis below which a point has no disparity, because it lies on the axis.


@inner
def linearise(landmark: Array, seen: Array, camera: CameraNumbers, T: Array, J: Array, e: Array) -> None:
    """Write the derivatives (3, 6) by [t; r] and the error (3,) of the view of a landmark; 0 for an unknown row."""
    focal, row0, width, baseline, left = camera
    x, y, z = moved(T, landmark[0], landmark[1], landmark[2])
    per_r = 1 / max(math.sqrt(x * x + y * y), MIN_RADIUS_M)
    along_x, along_y, scale = x * per_r, y * per_r, focal * per_r
    lower = row0 - scale * z
    column = (left - math.atan2(y, x)) * focal - 0.5
    e[0] = wrapped(seen[0] - column, width)
    e[1] = seen[1] - lower
    e[2] = 0.0 if math.isnan(seen[2]) else seen[2] - lower - scale * baseline
    # Column: f (left - atan2(y, x)); its derivative by a turn about z is -f.
    J[0, 0], J[0, 1], J[0, 2] = scale * along_y, -scale * along_x, 0.0
    J[0, 3], J[0, 4], J[0, 5] = -z * J[0, 1], z * J[0, 0], -focal
    # Rows: row0 - f height / r; a turn about z does not change them.
    for row in range(1, 3):
        outward = scale * per_r * (z if row == 1 else z - baseline)
        J[row, 0], J[row, 1], J[row, 2] = outward * along_x, outward * along_y, -scale
        J[row, 3], J[row, 4] = y * J[row, 2] - z * J[row, 1], z * J[row, 0] - x * J[row, 2]
        J[row, 5] = 0.0


@inner
def moved(T: Array, x: float, y: float, z: float) -> tuple[float, float, float]:
    """Return the point T p."""
    return (
        T[0, 0] * x + T[0, 1] * y + T[0, 2] * z + T[0, 3],
        T[1, 0] * x + T[1, 1] * y + T[1, 2] * z + T[1, 3],
        T[2, 0] * x + T[2, 1] * y + T[2, 2] * z + T[2, 3],
    )


@inner
def wrapped(difference: float, width: float) -> float:
    """Return a difference of columns in [-width / 2, width / 2)."""
    return difference - width * math.floor(difference / width + 0.5)
