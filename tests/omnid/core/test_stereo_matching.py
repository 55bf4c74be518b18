"""Matching two panoramas: walls that repeat, textures that do not, fractions, seams and the picture's end."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from omnid.core.disambiguation import line_difference, nearest_anchor
from omnid.core.stereo_matching import METHODS, Matcher, Matching
from tests.omnid.core.scenery import texture, turned

Image = NDArray[np.uint8]
Flags = NDArray[np.bool_]

SHAPE, SHIFT_PX, COURSE_PX, DISPARITIES = (160, 240), 20, 16, 44


def matched(method: str, lower: Image, upper: Image, valid: Flags) -> tuple[NDArray[np.intp], NDArray[np.float32]]:
    return Matcher(lower.shape, Matching(method=method, disparities=DISPARITIES)).match(lower, upper, valid)


def middle(rows: tuple[int, int] = (12, SHAPE[0] - DISPARITIES - 4)) -> Flags:
    """Pixels whose every candidate lies inside the picture."""
    valid = np.zeros(SHAPE, bool)
    valid[rows[0] : rows[1], 12:-12] = True
    return valid


def noisy(picture: Image, seed: int) -> Image:
    noise = np.random.default_rng(seed).normal(0, 1.5, picture.shape)
    return np.clip(np.rint(picture + noise), 0, 255).astype(np.uint8)


def brick_wall() -> tuple[Image, Image]:
    """Courses that look alike, one spot that does not, and the same SHIFT_PX lower; each with noise of its own."""
    course = texture(1, (COURSE_PX * 3, 40), 2.0)[COURSE_PX : 2 * COURSE_PX]
    wall = np.tile(course, (SHAPE[0] // COURSE_PX + 4, SHAPE[1] // 40 + 1))[:, : SHAPE[1]]
    spot = texture(2, (34, 34), 2.0)
    wall[60 + 2 * COURSE_PX : 94 + 2 * COURSE_PX, 100:134] = spot
    lower = wall[2 * COURSE_PX : 2 * COURSE_PX + SHAPE[0]]
    upper = wall[2 * COURSE_PX - SHIFT_PX : 2 * COURSE_PX - SHIFT_PX + SHAPE[0]]
    return noisy(lower, 3), noisy(upper, 4)


def right(found: tuple[NDArray[np.intp], NDArray[np.float32]]) -> Flags:
    """Which matches away from the spot have the true disparity."""
    pixels, disparity = found
    rows, columns = np.divmod(pixels, SHAPE[1])
    away = (np.abs(columns - 117) > 26) | (np.abs(rows - 77) > 26)
    return np.asarray(np.abs(disparity[away] - SHIFT_PX) < 1)


def test_on_a_brick_wall_the_enhanced_sad_is_right_where_the_original_is_wrong() -> None:
    wall = brick_wall()
    original, enhanced = (right(matched(method, *wall, middle())) for method in ("sad", "enhanced"))
    assert original.mean() < 0.6  # eq. (1) alone cannot tell the courses apart
    assert enhanced.mean() > 0.85
    assert enhanced.sum() > 1.3 * original.sum()


def test_on_a_texture_that_does_not_repeat_both_give_the_same() -> None:
    lower = texture(5, SHAPE)
    upper = np.roll(texture(5, SHAPE), SHIFT_PX, axis=0)
    original, enhanced = (matched(method, noisy(lower, 6), noisy(upper, 7), middle()) for method in ("sad", "enhanced"))
    assert len(original[0]) > 800
    np.testing.assert_array_equal(original[0], enhanced[0])
    assert np.mean(original[1] == enhanced[1]) > 0.99
    assert np.abs(original[1] - SHIFT_PX).max() < 0.6


@pytest.mark.parametrize("method", METHODS)
def test_fractions_of_a_pixel(method: str) -> None:
    lower = texture(8, SHAPE)
    upper = np.ascontiguousarray(np.rot90(turned(np.ascontiguousarray(np.rot90(lower)), 12.4), -1))
    pixels, disparity = matched(method, lower, upper, middle())
    assert len(pixels) > 800
    assert abs(np.median(disparity) - 12.4) < 0.05
    assert np.mean(np.abs(disparity - 12.4) < 0.25) > 0.95


@pytest.mark.parametrize("method", METHODS)
def test_what_has_no_match_gets_none(method: str) -> None:
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
def test_two_distances_side_by_side(method: str) -> None:
    """A near wall on the right, a far one on the left."""
    lower = texture(11, SHAPE)
    upper = np.where(np.arange(SHAPE[1]) < 120, np.roll(lower, 8, axis=0), np.roll(lower, 31, axis=0))
    pixels, disparity = matched(method, lower, upper, middle())
    columns = pixels % SHAPE[1]
    for side, expected in ((columns < 105, 8), (columns > 135, 31)):
        assert side.sum() > 250
        assert np.mean(np.abs(disparity[side] - expected) < 0.3) > 0.95


@pytest.mark.parametrize("method", METHODS)
def test_every_row_is_matched_whose_match_lies_in_the_picture(method: str) -> None:
    """Down to the floor: a small disparity needs no room for the largest."""
    lower, valid = texture(16, SHAPE), middle((12, SHAPE[0] - 16))
    pixels, disparity = matched(method, lower, np.roll(lower, 8, axis=0), valid)
    assert np.abs(disparity - 8).max() < 0.6
    assert (np.histogram(pixels // SHAPE[1], bins=11, range=(12, SHAPE[0] - 16))[0] > 50).all()


@pytest.mark.parametrize("method", METHODS)
def test_every_disparity_of_the_range_is_found(method: str) -> None:
    lower, valid = texture(17, SHAPE), middle()
    for shift in (3, 17, 33, DISPARITIES - 3):
        pixels, disparity = matched(method, lower, np.roll(lower, shift, axis=0), valid)
        assert len(pixels) > 800 and np.mean(np.abs(disparity - shift) < 0.6) > 0.98, shift


@pytest.mark.parametrize("method", METHODS)
def test_a_panorama_lower_than_the_range_is_matched_all_the_same(method: str) -> None:
    lower = texture(18, (DISPARITIES - 4, 240))
    pixels, disparity = matched(method, lower, np.roll(lower, 6, axis=0), np.ones(lower.shape, bool))
    inside = (pixels // 240 > 8) & (pixels // 240 < DISPARITIES - 16)
    assert inside.sum() > 100 and np.mean(np.abs(disparity[inside] - 6) < 0.6) > 0.95


def test_the_nearest_anchor_is_the_nearest() -> None:
    rng = np.random.default_rng(12)
    anchors, points = np.sort(rng.choice(160 * 240, 30, replace=False)), rng.choice(160 * 240, 200)
    chosen = nearest_anchor(SHAPE, anchors, points)
    a, p = (np.stack(np.divmod(x, SHAPE[1]), axis=1) for x in (anchors, points))
    distance = np.linalg.norm(p[:, None] - a[None], axis=2)
    taken = distance[np.arange(200), chosen]
    assert (taken <= 1.03 * distance.min(axis=1) + 0.1).all()  # the transform is exact to a few per cent
    np.testing.assert_array_equal(nearest_anchor(SHAPE, anchors, anchors), np.arange(30))


def test_the_difference_along_lines_is_that_of_the_pixels_on_them() -> None:
    lower, upper = texture(13, SHAPE), texture(14, SHAPE)
    ends = [np.array([[x, y]], np.float32) for x, y in ((10, 20), (42, 84), (50, 30), (18, 62))]
    along = (np.arange(32) + 0.5) / 32
    picked = []
    for picture, start, stop in ((lower, ends[0], ends[1]), (upper, ends[2], ends[3])):
        column, row = (start + along[:, None] * (stop - start)).T
        c, r = column.astype(int), row.astype(int)
        u, v = column - c, row - r
        picked.append((picture[r, c] * (1 - u) + picture[r, c + 1] * u) * (1 - v)
                      + (picture[r + 1, c] * (1 - u) + picture[r + 1, c + 1] * u) * v)
    expected = np.abs(picked[0] - picked[1]).mean()
    assert line_difference(lower, upper, (ends[0], ends[1], ends[2], ends[3]))[0] == pytest.approx(expected, abs=1.0)


def test_more_lines_than_a_short_counts() -> None:
    picture = texture(15, SHAPE)
    ends = [np.tile(np.array([[x, y]], np.float32), (70_000, 1)) for x, y in ((10, 20), (40, 80), (10, 20), (40, 80))]
    ends[2][-1] = 100, 100
    difference = line_difference(picture, picture, (ends[0], ends[1], ends[2], ends[3]), samples=4)
    assert (difference[:-1] == 0).all() and difference[-1] > 5
