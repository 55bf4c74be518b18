"""Points from two rays, their views, and how far to trust them."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from calib.panorama import Cylinder
from omnid.core.stereo.triangulation import common_perpendicular, point_covariance, triangulate, view, view_jacobian

Array = NDArray[np.float64]

CYLINDER, BASELINE_M = Cylinder(1304, 383, 128.5), 0.2


@pytest.fixture
def points() -> Array:
    """Points (40, 3) [m] all around, also straight behind."""
    rng = np.random.default_rng(1)
    azimuth, r = rng.uniform(-np.pi, np.pi, 40), rng.uniform(0.5, 4, 40)
    azimuth[0] = np.pi
    return np.column_stack([r * np.cos(azimuth), r * np.sin(azimuth), rng.uniform(-1.2, 1.5, 40)])


def test_rays_that_meet_give_the_point_whatever_their_length(points: Array) -> None:
    origin = np.array([0.1, -0.05, 0.3])
    lengths = np.random.default_rng(2).uniform(0.2, 5, (2, len(points), 1))
    found = common_perpendicular(lengths[0] * points, lengths[1] * (points - origin), origin)
    np.testing.assert_allclose(found, points, atol=1e-12)


def test_skew_rays_give_the_middle_between_them(points: Array) -> None:
    origin = np.array([0.0, 0.0, 0.2])
    lower = points
    upper = points - origin + np.random.default_rng(3).normal(0, 0.02, points.shape)
    found = common_perpendicular(lower, upper, origin)
    for n1, n2, middle in zip(lower, upper, found, strict=True):
        (along_lower, along_upper), *_ = np.linalg.lstsq(np.column_stack([n1, -n2]), origin, rcond=None)
        np.testing.assert_allclose(middle, (along_lower * n1 + along_upper * n2 + origin) / 2, atol=1e-9)


def test_rays_that_diverge_or_are_parallel_give_nothing() -> None:
    origin = np.array([0.0, 0, 0.2])
    lower = np.array([[1.0, 0, -0.1], [1, 0, 0], [1, 0, 0.1]])
    upper = np.array([[1.0, 0, 0.1], [2, 0, 0], [1, 0, 0]])
    found = common_perpendicular(lower, upper, origin)
    assert np.isnan(found[:2]).all()
    np.testing.assert_allclose(found[2], [2, 0, 0.2])


def test_views_lead_back_to_their_points(points: Array) -> None:
    views = view(points, CYLINDER, BASELINE_M)
    np.testing.assert_allclose(triangulate(views, CYLINDER, BASELINE_M), points, atol=1e-9)
    disparity = CYLINDER.focal_px * BASELINE_M / np.hypot(points[:, 0], points[:, 1])
    np.testing.assert_allclose(views[:, 2] - views[:, 1], disparity)


def test_the_jacobian_is_the_slope_of_the_view(points: Array) -> None:
    step = 1e-6
    slope = np.empty((len(points), 3, 3))
    for axis in range(3):
        moved = [view(points + sign * step * np.eye(3)[axis], CYLINDER, BASELINE_M) for sign in (1, -1)]
        change = moved[0] - moved[1]
        change[:, 0] = CYLINDER.wrap(change[:, 0])
        slope[:, :, axis] = change / (2 * step)
    np.testing.assert_allclose(view_jacobian(points, CYLINDER, BASELINE_M), slope, atol=1e-4)


def test_the_covariance_is_what_noisy_views_scatter(points: Array) -> None:
    sigma_px = 0.1
    rng = np.random.default_rng(4)
    said = point_covariance(points, CYLINDER, BASELINE_M, sigma_px)
    for point, covariance in zip(points[:6], said, strict=False):
        views = view(np.tile(point, (20_000, 1)), CYLINDER, BASELINE_M)
        seen = np.cov(triangulate(views + sigma_px * rng.standard_normal(views.shape), CYLINDER, BASELINE_M).T)
        # Of the form W^T S W = I, so that every direction counts, the short ones too.
        W = np.linalg.inv(np.linalg.cholesky(covariance))
        np.testing.assert_allclose(W @ seen @ W.T, np.eye(3), atol=0.12)
