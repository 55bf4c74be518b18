"""Compiled views, their derivatives and errors; see triangulation.py and pose_estimation.py for the equations.

camera: focal length, column of azimuth 0, row of the horizon, columns of a turn [px], and baseline [m].
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from omnid.core.compiled import compiled, inner

Array = NDArray[np.float64]
Vector = tuple[float, float, float]
Camera = tuple[float, float, float, float, float]

MIN_RADIUS = 1e-9  # guards against division by zero on the cylinder's axis, as that of calib.panorama


@compiled("(f8[:, :], f8, f8, f8[:, :, ::1])", writes=("J",))
def motion_jacobian(points: Array, focal_px: float, baseline_m: float, J: Array) -> None:
    """Write the derivatives (N, 3, 6) of the views of points (N, 3) [m] by small motions [t; r] of them."""
    for n in range(len(points)):
        write_motion_jacobian(points[n, 0], points[n, 1], points[n, 2], focal_px, baseline_m, J[n])


@inner
def write_motion_jacobian(x: float, y: float, z: float, focal_px: float, baseline_m: float, J: Array) -> None:
    """Write the derivatives (3, 6) of the view (column, lower row, upper row) by a small motion: p + t + r x p."""
    r2 = max(x * x + y * y, MIN_RADIUS**2)
    r = math.sqrt(r2)
    J[0, 0], J[0, 1], J[0, 2] = focal_px * y / r2, -focal_px * x / r2, 0.0
    for row in range(1, 3):
        rise = focal_px * (z if row == 1 else z - baseline_m) / (r2 * r)
        J[row, 0], J[row, 1], J[row, 2] = rise * x, rise * y, -focal_px / r
    for row in range(3):
        a, b, c = J[row, 0], J[row, 1], J[row, 2]
        J[row, 3], J[row, 4], J[row, 5] = y * c - z * b, z * a - x * c, x * b - y * a


@inner
def turned(T: Array, v: Vector) -> Vector:
    """Return the direction R v."""
    return (
        T[0, 0] * v[0] + T[0, 1] * v[1] + T[0, 2] * v[2],
        T[1, 0] * v[0] + T[1, 1] * v[1] + T[1, 2] * v[2],
        T[2, 0] * v[0] + T[2, 1] * v[1] + T[2, 2] * v[2],
    )


@inner
def moved(T: Array, p: Array) -> Vector:
    """Return the point T p."""
    x, y, z = turned(T, (p[0], p[1], p[2]))
    return x + T[0, 3], y + T[1, 3], z + T[2, 3]


@compiled(
    "(f8[:, :], f8[:, :], f8[:, :], f8[:, :, ::1], UniTuple(f8, 5), f8[:, :, ::1], f8[:, :, ::1])",
    writes=("E", "informed"),
)
def compare(T: Array, points: Array, views: Array, weights: Array, camera: Camera, E: Array, informed: Array) -> None:
    """Write [J, ..., e] to E (N, 3, 7 + K): the errors of views (N, 3) of points T p, and -J their first derivatives.

    informed (N, 3, 7 + K): the same columns of the weights (N, 3, 3) times E.
    """
    focal_px, column0, row0, turn_px, baseline_m = camera
    for n in range(len(points)):
        x, y, z = moved(T, points[n])
        r = max(math.sqrt(x * x + y * y), MIN_RADIUS)
        across = views[n, 0] - column0 + focal_px * math.atan2(y, x)
        write_motion_jacobian(x, y, z, focal_px, baseline_m, E[n])
        E[n, 0, -1] = across - turn_px * math.floor(across / turn_px + 0.5)
        E[n, 1, -1] = views[n, 1] - row0 + focal_px * z / r
        E[n, 2, -1] = views[n, 2] - row0 + focal_px * (z - baseline_m) / r
        for i in range(3):
            W = weights[n, i]
            for a in range(-1, 6):
                informed[n, i, a] = W[0] * E[n, 0, a] + W[1] * E[n, 1, a] + W[2] * E[n, 2, a]
