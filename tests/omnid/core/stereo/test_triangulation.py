"""Triangulation: points from two rays, their views, Jacobians and covariances."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from calib.panorama import Cylinder
from omnid.core.stereo.triangulation import point_covariance, triangulate, view, view_jacobian

Array = NDArray[np.float64]

CYLINDER, BASELINE_M = Cylinder(1304, 383, 128.5), 0.2


@pytest.fixture
def points() -> Array:
    """Return points (40, 3) [m] all around, one of them straight behind."""
    rng = np.random.default_rng(1)
    azimuth, r = rng.uniform(-np.pi, np.pi, 40), rng.uniform(0.5, 4, 40)
    azimuth[0] = np.pi
    return np.column_stack([r * np.cos(azimuth), r * np.sin(azimuth), rng.uniform(-1.2, 1.5, 40)])


def test_jacobian_equals_the_numeric_derivative(points: Array) -> None:
    step = 1e-6
    slope = np.empty((len(points), 3, 3))
    for axis in range(3):
        moved = [view(points + sign * step * np.eye(3)[axis], CYLINDER, BASELINE_M) for sign in (1, -1)]
        change = moved[0] - moved[1]
        change[:, 0] = CYLINDER.wrap(change[:, 0])
        slope[:, :, axis] = change / (2 * step)
    np.testing.assert_allclose(view_jacobian(points, CYLINDER, BASELINE_M), slope, atol=1e-4)


def test_covariance_equals_the_scatter_of_noisy_views(points: Array) -> None:
    sigma_px = 0.1
    rng = np.random.default_rng(4)
    covariances = point_covariance(points, CYLINDER, BASELINE_M, sigma_px)
    for point, covariance in zip(points[:6], covariances, strict=False):
        views = view(np.tile(point, (20_000, 1)), CYLINDER, BASELINE_M)
        seen = np.cov(triangulate(views + sigma_px * rng.standard_normal(views.shape), CYLINDER, BASELINE_M).T)
        # Whitened: W^T S W = I, so that the short axes count as much as the long ones.
        W = np.linalg.inv(np.linalg.cholesky(covariance))
        np.testing.assert_allclose(W @ seen @ W.T, np.eye(3), atol=0.12)
