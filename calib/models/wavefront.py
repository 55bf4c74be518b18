"""Rays of a mirror camera that do not meet in one point, by aberrations of the reflected wavefront.

The light that a camera receives by a mirror is a normal congruence (Malus and Dupin): a ray of direction d passes the
viewpoint at the offset grad W(d), the gradient on the sphere of the wavefront's support function W. With the
stereographic coordinates m = (x, y) / (1 + z) about the camera's axis and q = 1 / (1 + m^2),

    W = q (a (m_x^2 - m_y^2) + b m_x m_y + m^2 (c_x m_x + c_y m_y) + s m^4):

astigmatism a, b, coma c_x, c_y, spherical aberration s [m]. To first order these are the wavefronts of a parabolic
mirror that is not round, of a camera tilted below it, and of a mirror off the paraboloid; lower terms only move the
viewpoint.
"""

from __future__ import annotations

import numpy as np

from calib.models.camera import Array

# The terms a, b, c_x, c_y, s, as files and results name them.
WAVEFRONT_NAMES = ("w_a", "w_b", "w_x", "w_y", "w_s")
# Iterations of the direction, because each reduces its error by the offset as a fraction of the distance, 1 / 1000.
STEPS = 4
# Least value of 1 + z, for directions opposite to the axis: guards against division by zero.
MIN_DENOMINATOR = 0.05


def offsets(directions: Array, wavefront: tuple[float, ...], axis: float) -> Array:
    """Return the offsets (N, 3) [m] from the viewpoint, perpendicular to unit directions (N, 3).

    axis: 1 or -1, the sign of z along the ray of the camera's centre.
    """
    a, b, c_x, c_y, s = wavefront
    x, y, z = directions[:, 0], directions[:, 1], axis * directions[:, 2]
    n = 1 / np.maximum(1 + z, MIN_DENOMINATOR)
    r2, square, coma = x * x + y * y, a * (x * x - y * y) + b * x * y, c_x * x + c_y * y
    # W = (n square + n^2 r2 coma + n^3 s r2^2) / 2, because 1 / (1 + m^2) = (1 + z) / 2 on the sphere.
    by_x = n * (2 * a * x + b * y) + n**2 * (2 * x * coma + r2 * c_x) + 4 * n**3 * s * r2 * x
    by_y = n * (b * x - 2 * a * y) + n**2 * (2 * y * coma + r2 * c_y) + 4 * n**3 * s * r2 * y
    by_z = -(n**2 * square + 2 * n**3 * r2 * coma + 3 * n**4 * s * r2 * r2)
    gradient = np.column_stack([by_x, by_y, axis * by_z]) / 2
    return np.asarray(gradient - directions * (gradient * directions).sum(axis=1, keepdims=True))


def directions_to(points: Array, wavefront: tuple[float, ...], axis: float) -> Array:
    """Return the unit directions (N, 3) of the rays through points (N, 3) [m]; NaN for the viewpoint itself."""
    norm = np.linalg.norm(points, axis=1, keepdims=True)
    directions = points / np.where(norm > 0, norm, np.nan)
    for _ in range(STEPS):
        rays = points - offsets(directions, wavefront, axis)
        directions = rays / np.linalg.norm(rays, axis=1, keepdims=True)
    return np.asarray(directions)


def points_at(distance_m: float, directions: Array, wavefront: tuple[float, ...], axis: float) -> Array:
    """Return unit vectors (N, 3) to the points of the rays of unit directions (N, 3) at a distance [m]."""
    across = offsets(directions, wavefront, axis) / distance_m
    along = np.sqrt(np.maximum(0.0, 1 - (across**2).sum(axis=1, keepdims=True)))
    return np.asarray(along * directions + across)
