"""Matching two panoramas: textures, subpixel disparities, borders; triangulation: points, Jacobians, covariances."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from calib.panorama import Cylinder
from omnid.core.stereo.matcher import Matcher, MatchingSettings
from omnid.core.stereo.semiglobal import ColumnShift
from omnid.core.stereo.triangulation import point_covariance, triangulate, view
from tests.omnid.core.scenery import texture, turned

Image = NDArray[np.uint8]
Flags = NDArray[np.bool_]

SHAPE, SHIFT_PX, COURSE_PX, DISPARITIES = (160, 240), 20, 16, 44
METHODS = ("sad", "enhanced", "semiglobal")


def matched(method: str, lower: Image, upper: Image, valid: Flags) -> tuple[NDArray[np.intp], NDArray[np.float32]]:
    return Matcher(lower.shape, MatchingSettings(method=method, disparities=DISPARITIES)).match(lower, upper, valid)


def middle(rows: tuple[int, int] = (12, SHAPE[0] - DISPARITIES - 4)) -> Flags:
    """Return the pixels whose candidates all lie inside the image."""
    valid = np.zeros(SHAPE, bool)
    valid[rows[0] : rows[1], 12:-12] = True
    return valid


def noisy(image: Image, seed: int) -> Image:
    noise = np.random.default_rng(seed).normal(0, 1.5, image.shape)
    return np.clip(np.rint(image + noise), 0, 255).astype(np.uint8)


def brick_wall() -> tuple[Image, Image]:
    """Return a wall of identical courses with one unique spot, and the same wall SHIFT_PX lower, both with noise."""
    course = texture(1, (COURSE_PX * 3, 40), 2.0)[COURSE_PX : 2 * COURSE_PX]
    wall = np.tile(course, (SHAPE[0] // COURSE_PX + 4, SHAPE[1] // 40 + 1))[:, : SHAPE[1]]
    spot = texture(2, (34, 34), 2.0)
    wall[60 + 2 * COURSE_PX : 94 + 2 * COURSE_PX, 100:134] = spot
    lower = wall[2 * COURSE_PX : 2 * COURSE_PX + SHAPE[0]]
    upper = wall[2 * COURSE_PX - SHIFT_PX : 2 * COURSE_PX - SHIFT_PX + SHAPE[0]]
    return noisy(lower, 3), noisy(upper, 4)


def right(found: tuple[NDArray[np.intp], NDArray[np.float32]]) -> Flags:
    """Return flags of the matches away from the spot: True where the disparity is right."""
    pixels, disparity = found
    rows, columns = np.divmod(pixels, SHAPE[1])
    away = (np.abs(columns - 117) > 26) | (np.abs(rows - 77) > 26)
    return np.asarray(np.abs(disparity[away] - SHIFT_PX) < 1)


def test_enhanced_sad_is_right_on_a_brick_wall_where_sad_is_wrong() -> None:
    wall = brick_wall()
    original, enhanced = (right(matched(method, *wall, middle())) for method in ("sad", "enhanced"))
    assert original.mean() < 0.6  # eq. (1) alone cannot tell the courses apart
    assert enhanced.mean() > 0.95
    assert enhanced.sum() > 1.5 * original.sum()


@pytest.mark.parametrize("method", METHODS)
def test_disparities_are_subpixel(method: str) -> None:
    lower = texture(8, SHAPE)
    upper = np.ascontiguousarray(np.rot90(turned(np.ascontiguousarray(np.rot90(lower)), 12.4), -1))
    pixels, disparity = matched(method, lower, upper, middle())
    assert len(pixels) > 800
    assert abs(np.median(disparity) - 12.4) < 0.05
    assert np.mean(np.abs(disparity - 12.4) < 0.25) > 0.95


@pytest.mark.parametrize("method", METHODS)
def test_pixels_without_a_match_are_left_out(method: str) -> None:
    blank, other = np.full(SHAPE, 90, np.uint8), texture(9, SHAPE)
    assert len(matched(method, blank, other, middle())[0]) == 0
    lower, valid = texture(10, SHAPE), middle()
    upper = np.roll(lower, SHIFT_PX, axis=0)
    upper[:, 120:] = other[:, 120:]
    pixels, _ = matched(method, lower, upper, valid)
    hidden = pixels % SHAPE[1] > 130
    assert hidden.sum() < 0.25 * (~hidden).sum()
    assert valid.reshape(-1)[pixels].all()


@pytest.mark.parametrize("method", METHODS)
def test_two_depths_side_by_side_are_found(method: str) -> None:
    """A near wall on the right, a far one on the left."""
    lower = texture(11, SHAPE)
    upper = np.where(np.arange(SHAPE[1]) < 120, np.roll(lower, 8, axis=0), np.roll(lower, 31, axis=0))
    pixels, disparity = matched(method, lower, upper, middle())
    columns = pixels % SHAPE[1]
    for side, expected in ((columns < 105, 8), (columns > 135, 31)):
        assert side.sum() > 250
        assert np.mean(np.abs(disparity[side] - expected) < 0.3) > 0.95


def test_the_search_follows_columns_that_have_moved() -> None:
    """A pair that is not synchronised: near points are shifted to the side in the upper panorama, by a known amount."""
    lower, sideways_px = texture(21, SHAPE, 1.2), 2.0
    upper = np.roll(turned(lower, sideways_px), SHIFT_PX, axis=0)
    expected = ColumnShift(
        np.full(SHAPE, sideways_px / 2, np.float32), np.full(SHAPE, sideways_px / 2 / SHIFT_PX, np.float32)
    )
    matcher = Matcher(SHAPE, MatchingSettings(disparities=DISPARITIES))
    errors = [
        np.abs(matcher.match(lower, upper, middle(), column_shift=shift)[1] - SHIFT_PX) for shift in (expected, None)
    ]
    assert len(errors[0]) > 500 and np.mean(errors[0] < 0.2) > 0.85
    assert np.mean(errors[1] < 0.2) < 0.6


Array = NDArray[np.float64]

CYLINDER, BASELINE_M = Cylinder(1304, 383, 128.5), 0.2


@pytest.fixture
def points() -> Array:
    """Return points (40, 3) [m] all around, one of them straight behind."""
    rng = np.random.default_rng(1)
    azimuth, r = rng.uniform(-np.pi, np.pi, 40), rng.uniform(0.5, 4, 40)
    azimuth[0] = np.pi
    return np.column_stack([r * np.cos(azimuth), r * np.sin(azimuth), rng.uniform(-1.2, 1.5, 40)])


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
