"""Corners spread over the panorama, and their disparity in the pair."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from omnid.core.odometry.corners import clear_around, corners, nearby_disparity, pixels_in_upper
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


def test_within_a_cell_the_strongest_come_first() -> None:
    image = (texture(3) // 5 + 100).astype(np.uint8)
    strong = [(24 + 48 * k, 24) for k in range(10)]
    for column, row in strong:
        image[row : row + 6, column : column + 6] = 255
    first = corners(wrapped(image), np.arange(120)[:, None] * np.ones((1, 480)) < 48, 10)
    assert all(np.min(np.hypot(*(first - (c + 2.5, r + 2.5)).T)) < 6 for c, r in strong)


def test_cells_are_angles() -> None:
    """In a panorama of half the images' resolution a cell has half as many columns: faint halves of cells are cells."""
    is_faint = np.arange(480) % 48 >= 24
    image = np.where(is_faint, texture(3) // 5 + 100, texture(3)).astype(np.uint8)
    usable = ALL & (np.arange(120)[:, None] < 24)
    found = [corners(replace(wrapped(image), scale=scale), usable, 20) for scale in (1.0, 0.5)]
    of_faint = [int(is_faint[points[:, 0].astype(int)].sum()) for points in found]
    assert of_faint[0] == 0 and of_faint[1] >= 9


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


def test_a_blank_wall_has_no_corners() -> None:
    assert corners(wrapped(np.full((120, 480), 80, np.uint8)), ALL, 100).shape == (0, 2)


def test_discs_around_known_points_are_left_out() -> None:
    free = clear_around(ALL, np.array([[50.2, 60.0], [0.0, 0.0]]), 9)
    rows, columns = np.nonzero(~free)
    assert np.minimum(np.hypot(columns - 50, rows - 60), np.hypot(columns, rows)).max() <= 9.5
    assert not free[60, 41:60].any() and free[60, 62] and free[60, 38]
    assert ALL.all()


def test_the_disparity_is_the_median_of_near_pixels_also_across_the_seam() -> None:
    disparity = np.full((120, 480), np.nan, np.float32)
    disparity[60, [100, 101, 102]] = 7.0, 9.0, 30.0
    disparity[80, 479] = 5.0
    disparity[0, 300] = 4.0
    points = np.array([[101.4, 61.0], [101, 64], [1.0, 79.0], [300, 2], [250, 50]])
    np.testing.assert_array_equal(nearby_disparity(disparity, points), [9, np.nan, 5, 4, np.nan])
    assert np.isnan(nearby_disparity(disparity, points, 0)[0])
    assert nearby_disparity(disparity, np.zeros((0, 2))).shape == (0,)


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


def test_refuses_a_match_in_another_column_or_above_the_point() -> None:
    lower = texture(7)
    points = corners(wrapped(lower), ALL, 100)
    aside = wrapped(np.roll(turned(lower, 1.5), 6, axis=0))
    assert (
        np.isnan(rows_in_upper((wrapped(lower), aside), points, points[:, 1] + 6, KltSettings(levels=1))).mean() > 0.95
    )
    above = wrapped(np.roll(lower, -6, axis=0))
    assert np.isnan(rows_in_upper((wrapped(lower), above), points, points[:, 1] - 6, KltSettings(levels=1))).all()


def rows_in_upper(
    pair: tuple[PaddedPanorama, PaddedPanorama],
    points: NDArray[np.float64],
    guess: NDArray[np.float64],
    klt: KltSettings,
) -> NDArray[np.float64]:
    """Rows (N,) where the guessed rows are in the columns of the points."""
    return pixels_in_upper(pair, points, np.column_stack([points[:, 0], guess]), klt)[:, 1]


def test_a_match_may_lie_aside_as_far_as_the_motion_may_have_moved_it() -> None:
    lower = texture(3)
    upper = wrapped(np.roll(np.roll(lower, 9, axis=0), 4, axis=1))
    points = corners(wrapped(lower), np.ones(lower.shape, bool), 60)
    points = points[(points[:, 1] > 20) & (points[:, 1] < 90)]
    guess = points + np.array([2.0, 9.0])
    pair, klt = (wrapped(lower), upper), KltSettings(levels=1)
    assert np.isnan(pixels_in_upper(pair, points, guess, klt)).mean() > 0.9
    found = pixels_in_upper(pair, points, guess, klt, np.full(len(points), 2.0))
    known = np.isfinite(found[:, 0])
    assert known.mean() > 0.9
    aside = (found - points)[known] - [4.0, 9.0]
    aside[:, 0] = (aside[:, 0] + 240) % 480 - 240
    assert np.median(np.abs(aside)) < 0.05


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
