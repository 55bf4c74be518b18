"""Colours, shapes and sizes as arrays, without rerun."""

from __future__ import annotations

import numpy as np
import pytest

from calib import se3
from omnid.viewer import style


def test_an_ellipsoid_has_the_axes_of_the_covariance() -> None:
    """On its surface the Mahalanobis distance is three everywhere."""
    R = se3.rotation_exp([0.3, -0.5, 0.2])
    covariance = R @ np.diag([0.04, 0.09, 0.01]) @ R.T
    found = style.ellipsoid(covariance)
    assert found is not None and found.magnified == 1 and found.largest_m == pytest.approx(0.9)
    np.testing.assert_allclose(found.R.T @ found.R, np.eye(3), atol=1e-12)
    assert np.linalg.det(found.R) == pytest.approx(1)
    directions = np.random.default_rng(0).normal(size=(50, 3))
    surface = (directions / np.linalg.norm(directions, axis=1)[:, None] * found.half_m) @ found.R.T
    squared = np.einsum("ni,ij,nj->n", surface, np.linalg.inv(covariance), surface)
    np.testing.assert_allclose(squared, style.SIGMAS**2, rtol=1e-9)


@pytest.mark.parametrize(
    ("sigma_m", "magnified"), [(0.5, 1), (0.017, 1), (0.016, 10), (1e-3, 100), (1e-6, 1000), (0, 1)]
)
def test_small_ellipsoids_are_magnified(sigma_m: float, magnified: int) -> None:
    found = style.ellipsoid(sigma_m**2 * np.eye(3))
    assert found is not None and found.magnified == magnified
    assert found.half_m.max() == pytest.approx(3 * sigma_m * magnified)
    assert found.largest_m == pytest.approx(3 * sigma_m)


def test_an_invalid_covariance_has_no_ellipsoid() -> None:
    assert style.ellipsoid(np.full((3, 3), np.nan)) is None
    bent = style.ellipsoid(np.diag([1.0, -1e-9, 1.0]))  # as rounding produces
    assert bent is not None and bent.half_m.min() == 0


def test_states_differ_without_colours() -> None:
    """States differ in width, kinds of features in shape."""
    widths = [entry.size_px for entry in style.STATES.values()]
    assert list(style.STATES) == ["tracking", "degraded", "lost"] and sorted(widths) == widths
    assert min(np.diff(widths)) >= 1.5
    assert style.state_style("nonsense") == style.UNKNOWN
    pixels = np.array([[10.0, 20.0], [30.0, 5.0]])
    crosses, squares = style.crosses(pixels, 2), style.squares(pixels, 2)
    assert crosses.shape == (4, 2, 2) and squares.shape == (2, 5, 2)
    np.testing.assert_array_equal(crosses.mean(axis=1), np.repeat(pixels, 2, axis=0))
    np.testing.assert_array_equal(squares[:, :4].mean(axis=1), pixels)
    np.testing.assert_array_equal(squares[:, 0], squares[:, 4])
    assert style.crosses(np.zeros((0, 2)), 2).shape == (0, 2, 2)


def test_depth_image_has_the_nearest_distance_in_front() -> None:
    disparity = np.full((9, 12), np.nan, np.float32)
    disparity[4, 4], disparity[4, 5] = 10, 40
    disparity[0, 0] = 1e-9  # beyond the largest distance
    mm = style.depth_image(disparity, 20.0)
    assert mm.dtype == np.uint16 and mm[4, 3] == 2000 and mm[4, 4] == mm[3, 6] == 500
    assert mm[0, 0] == mm[1, 1] == 65535 and mm[8, 11] == 0 and (mm > 0).sum() == 12 + 4
    assert style.depth_range(np.array([[0, 1000, 3000]], np.uint16)) == pytest.approx((0, 2900))
    assert style.depth_range(np.zeros((2, 2), np.uint16)) == (0.0, 1.0)


def test_points_are_thinned_evenly_and_coloured_by_height() -> None:
    points = np.arange(3000.0).reshape(-1, 3)
    few, numbers = style.evenly(300, points, np.arange(1000))
    assert len(few) == 250 and np.array_equal(few, points[numbers])
    assert style.evenly(1000, points)[0] is not None and len(style.evenly(1000, points)[0]) == 1000
    grey = style.by_height(points).astype(int).sum(axis=1)
    assert grey[0] < grey[500] < grey[-1]
    assert style.by_height(points[:0]).shape == (0, 3) and style.by_height(points[:1]).shape == (1, 3)
