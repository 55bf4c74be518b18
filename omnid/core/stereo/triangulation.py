"""Triangulation: points from the rows of both panoramas, and their covariance."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from calib import se3
from calib.panorama import MIN_RADIUS, Cylinder

Array = NDArray[np.float64]

# Angle below which two rays count as parallel: a point 1,000 km away, because of rounding.
MIN_DISPARITY_RAD = 1e-7


def triangulate(views: Array, cylinder: Cylinder, baseline_m: float) -> Array:
    """Return points (N, 3) [m] in the rectified frame of views (N, 3) = (column, row in lower, row in upper) [px].

    Both rays of a view lie in one plane through the axis, so that they meet: at r = f t / disparity, the solution of
    Dang et al. 2012, eq. (2) to (5). NaN for rays that are parallel or diverge.
    """
    disparity = views[:, 2] - views[:, 1]
    disparity = np.where(disparity > MIN_DISPARITY_RAD * cylinder.focal_px, disparity, np.nan)
    return np.asarray(cylinder.rays(views[:, :2]) * (cylinder.focal_px * baseline_m / disparity)[:, None])


def view(points: Array, cylinder: Cylinder, baseline_m: float) -> Array:
    """Return views (N, 3) = (column, row in lower, row in upper) [px] of points (N, 3) [m] in the rectified frame."""
    lower = cylinder.pixels(points)
    disparity = cylinder.focal_px * baseline_m / np.maximum(np.hypot(points[:, 0], points[:, 1]), MIN_RADIUS)
    return np.column_stack([lower, lower[:, 1] + disparity])


def view_jacobian(points: Array, cylinder: Cylinder, baseline_m: float) -> Array:
    """Return the derivatives (N, 3, 3) [px/m] of the view (column, lower row, upper row) by the point."""
    x, y, z = points.T
    r2 = np.maximum(x * x + y * y, MIN_RADIUS**2)
    r, f = np.sqrt(r2), cylinder.focal_px
    J = np.zeros((len(points), 3, 3))
    J[:, 0, 0], J[:, 0, 1] = f * y / r2, -f * x / r2
    for row, height in ((1, z), (2, z - baseline_m)):
        J[:, row, 0], J[:, row, 1], J[:, row, 2] = f * height * x / (r2 * r), f * height * y / (r2 * r), -f / r
    return J


def motion_jacobian(points: Array, cylinder: Cylinder, baseline_m: float) -> Array:
    """Return the derivatives (N, 3, 6) of the view by a small motion [t; r] of the point: p + t + r x p."""
    of_point = np.concatenate([np.broadcast_to(np.eye(3), (len(points), 3, 3)), -se3.hat(points)], axis=2)
    return np.asarray(view_jacobian(points, cylinder, baseline_m) @ of_point)


def point_covariance(
    points: Array, cylinder: Cylinder, baseline_m: float, sigma_px: float, noise: Array | None = None
) -> Array:
    """Return covariances (N, 3, 3) [m^2] of points triangulated from views of sigma_px in each coordinate.

    noise: covariance (N, 3, 3) [px^2] of the views in addition to it; None: none.
    """
    J = np.linalg.inv(view_jacobian(points, cylinder, baseline_m))
    of_views = sigma_px**2 * np.eye(3) + (0.0 if noise is None else noise)
    return np.asarray(J @ of_views @ np.swapaxes(J, -1, -2))
