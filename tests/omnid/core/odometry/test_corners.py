"""Corners spread over the panorama, and their disparity in the pair."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from omnid.core.odometry.corners import corners, pixels_in_upper
from omnid.core.odometry.tracking import KltSettings
from omnid.core.types.panorama import PaddedPanorama
from tests.omnid.core.scenery import texture, turned, wrapped

ALL = np.ones((120, 480), bool)


def test_a_poster_full_of_contrast_does_not_take_all_corners() -> None:
    faint = (texture(1) // 5 + 100).astype(np.uint8)
    faint[:, 200:280] = texture(2)[:, 200:280]
    found = corners(wrapped(faint), ALL, 100)
    on_poster = (found[:, 0] >= 195) & (found[:, 0] < 285)
    assert len(found) == 100
    assert on_poster.mean() < 0.4
    assert (np.histogram(found[:, 0], bins=10, range=(0, 480))[0] >= 4).all()


def test_corners_are_apart_and_within_the_usable_pixels() -> None:
    usable = ALL.copy()
    usable[:, 100:300] = False
    found = corners(wrapped(texture(4)), usable, 1000)
    assert usable[found[:, 1].astype(int), found[:, 0].astype(int)].all()
    assert len(found) > 50
    apart = np.abs(found[:, None] - found[None]).max(axis=2) + 100 * np.eye(len(found))
    assert apart.min() >= 5
    assert len(corners(wrapped(texture(4)), ALL, 7)) == 7


def test_the_seam_changes_nothing() -> None:
    """The same corners are found in the rotated panorama."""
    found = corners(wrapped(texture(5)), ALL, 1000)
    after = corners(wrapped(turned(texture(5), 200)), ALL, 1000)
    assert set(map(tuple, (found + np.array([200, 0])) % (480, 1000))) == set(map(tuple, after))


def test_rows_in_the_upper_panorama_are_found_to_sub_pixels() -> None:
    lower = texture(6)
    upper = np.rot90(turned(np.ascontiguousarray(np.rot90(lower)), 10.4), -1)  # 10.4 rows down
    points = corners(wrapped(lower), np.arange(120)[:, None] * np.ones((1, 480)) < 90, 200)
    points = points[points[:, 1] > 15]
    pair = wrapped(lower), wrapped(np.ascontiguousarray(upper))
    rows = rows_in_upper(pair, points, points[:, 1] + 9.5, KltSettings(levels=1))
    assert np.isfinite(rows).mean() > 0.9
    assert np.nanmax(np.abs(rows - points[:, 1] - 10.4)) < 0.1
    guess = points[:, 1] + np.where(np.arange(len(points)) % 2, 9.5, np.nan)
    assert np.isnan(rows_in_upper(pair, points, guess, KltSettings(levels=1))[::2]).all()


def rows_in_upper(
    pair: tuple[PaddedPanorama, PaddedPanorama],
    points: NDArray[np.float64],
    guess: NDArray[np.float64],
    klt: KltSettings,
) -> NDArray[np.float64]:
    """Rows (N,) where the guessed rows are in the columns of the points."""
    return pixels_in_upper(pair, points, np.column_stack([points[:, 0], guess]), klt)[:, 1]


def test_noise_is_no_corner() -> None:
    """The threshold follows the noise that the panorama is said to have."""
    noise = np.random.default_rng(2).normal(100, 12, (120, 480))
    image = np.clip(noise, 0, 255).astype(np.uint8)
    image[40:60, 200:230] = 220  # an object
    usable = np.zeros(image.shape, bool)
    usable[10:110] = True
    quiet = wrapped(image)
    noisy = PaddedPanorama(quiet.image, quiet.pad_px, noise_grey=12.0)
    found = corners(noisy, usable, 1000)
    assert len(corners(quiet, usable, 1000)) > 300 > 5 * len(found)
    of_object = np.array([[200.0, 40], [229, 40], [200, 59], [229, 59]])
    assert np.linalg.norm(of_object[:, None] - found[None], axis=2).min(axis=1).max() < 4
