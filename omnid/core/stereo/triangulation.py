"""Triangulation: points from the rows of both panoramas, and their covariance."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from calib.panorama import MIN_RADIUS, Cylinder
from omnid.core.stereo import view_kernels

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


def motion_jacobian(points: Array, cylinder: Cylinder, baseline_m: float) -> Array:
    """Return the derivatives (N, 3, 6) of the view by a small motion [t; r] of the point: p + t + r x p.

    The first three columns are those by the point [px/m].
    """
    J = np.empty((len(points), 3, 6))
    view_kernels.motion_jacobian(points, cylinder.focal_px, baseline_m, J)
    return J


def point_covariance(
    points: Array, cylinder: Cylinder, baseline_m: float, sigma_px: float, noise: Array | float = 0.0
) -> Array:
    """Return covariances (N, 3, 3) [m^2] of points triangulated from views of sigma_px in each coordinate.

    noise: covariance (N, 3, 3) [px^2] of the views in addition to it.
    """
    J = np.linalg.inv(motion_jacobian(points, cylinder, baseline_m)[:, :, :3])
    return np.asarray(J @ (sigma_px**2 * np.eye(3) + noise) @ np.swapaxes(J, -1, -2))
