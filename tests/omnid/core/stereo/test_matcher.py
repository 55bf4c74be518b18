"""Matching two panoramas: repeated and unique textures, subpixel disparities, borders of the image."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from calib import se3
from omnid.core.stereo.matcher import METHODS, Matcher, MatchingSettings, smooth
from omnid.core.stereo.semiglobal import ColumnShift
from tests.omnid.core.scenery import PAD_PX, RenderedCameras, texture, turned
from tests.simulation import make_rig, room

Image = NDArray[np.uint8]
Flags = NDArray[np.bool_]

SHAPE, SHIFT_PX, COURSE_PX, DISPARITIES = (160, 240), 20, 16, 44


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


def test_sad_takes_the_lowest_sum_with_left_right_check() -> None:
    """The lowest of eq. (1), written out, from the lower pixel and from the upper one."""
    lower, upper = brick_wall()
    pixels, disparity = matched("sad", lower, upper, middle())
    soft = [smooth(image, 0.8).astype(int) for image in (lower, upper)]
    window = np.arange(-4, 5)

    def cost(row: int, column: int, d: int) -> float:
        if not 0 <= row <= SHAPE[0] - 1 - d or not 0 <= d < DISPARITIES:
            return np.inf
        here, columns = np.clip(row + window, 0, SHAPE[0] - 1 - d), column + window
        return float(np.abs(soft[0][np.ix_(here, columns)] - soft[1][np.ix_(here + d, columns)]).sum())

    for pixel, found in list(zip(pixels, disparity, strict=True))[::40]:
        row, column = divmod(int(pixel), SHAPE[1])
        down = [cost(row, column, d) for d in range(DISPARITIES)]
        best = int(np.argmin(down))
        up = [cost(row + best - d, column, d) for d in range(DISPARITIES)]
        assert abs(found - best) <= 0.5
        assert down[best] <= 12 * 81 and abs(int(np.argmin(up)) - best) <= 1


@pytest.mark.parametrize("method", METHODS)
def test_no_valid_pixels_give_no_matches(method: str) -> None:
    image = texture(19, SHAPE)
    pixels, disparity = matched(method, image, image, np.zeros(SHAPE, bool))
    assert len(pixels) == len(disparity) == 0


class RenderedRoom:
    """Panoramas of a rig in the middle of a closed room with true disparities; each wall has one texture."""

    HALF_M, HEIGHT_M, EYE_M, DISPARITIES = 1.3, 2.6, 1.2, 56

    def __init__(self, *walls: str) -> None:
        rig = make_rig(size=512, baseline_m=0.2)
        cameras = RenderedCameras.of(rig, room(3, (2 * self.HALF_M, 2 * self.HALF_M), 0, (*walls, "tiles")))
        self._frame = cameras.frame(0, se3.transform(np.eye(3), np.array([0, 0, self.EYE_M])))
        height, width = self._frame.lower.image.shape
        self._shape, self._valid = (height, width), np.zeros((height, width), bool)
        self._valid[:, PAD_PX:-PAD_PX] = cv2.erode(cameras.usable.astype(np.uint8), np.ones((15, 15), np.uint8))
        self._cylinder, self._R, self._baseline_m = cameras.cylinder, rig.T_rect_rig[:3, :3], rig.baseline_m

    def disparity(self, pixels: NDArray[np.intp]) -> NDArray[np.float64]:
        """Return the true disparities (N,) of pixels of the lower panorama."""
        rows, columns = np.divmod(pixels, self._shape[1])
        rays = self._cylinder.rays(np.stack([columns - PAD_PX, rows], axis=1).astype(float)) @ self._R
        ahead = np.where(
            rays > 0, [self.HALF_M, self.HALF_M, self.HEIGHT_M - self.EYE_M], [self.HALF_M, self.HALF_M, self.EYE_M]
        )
        distance = (ahead / np.maximum(np.abs(rays), 1e-9)).min(axis=1)
        return np.asarray(self._cylinder.focal_px * self._baseline_m / distance)

    def counts(self, method: str) -> tuple[int, int]:
        """Return the number of matches right to a pixel, and of wrong ones."""
        matcher = Matcher(self._shape, MatchingSettings(method=method, disparities=self.DISPARITIES))
        pixels, disparity = matcher.match(self._frame.lower.image, self._frame.upper.image, self._valid)
        wrong = np.abs(disparity - self.disparity(pixels)) > 1
        return int((~wrong).sum()), int(wrong.sum())


def test_enhanced_sad_has_few_wrong_matches_in_a_brick_room() -> None:
    """The experiment of the paper: a room of bricks with the viewpoints at 1.2 m and 1.4 m."""
    bricks = RenderedRoom("brick", "brick", "brick", "brick")
    (right, wrong), (enhanced_right, enhanced_wrong) = bricks.counts("sad"), bricks.counts("enhanced")
    assert wrong > 0.3 * right  # or there was nothing to improve
    assert enhanced_wrong <= wrong / 3
    assert enhanced_right > 2 * right


def test_enhanced_sad_loses_no_matches_in_a_room_of_unique_textures() -> None:
    control = RenderedRoom("granite", "plaster", "granite", "plaster")
    (right, wrong), (enhanced_right, enhanced_wrong) = control.counts("sad"), control.counts("enhanced")
    assert right > 3000 and wrong < 0.05 * right
    assert enhanced_right >= right and enhanced_wrong <= wrong + 0.005 * right


@pytest.mark.parametrize("method", METHODS)
def test_disparities_are_subpixel(method: str) -> None:
    lower = texture(8, SHAPE)
    upper = np.ascontiguousarray(np.rot90(turned(np.ascontiguousarray(np.rot90(lower)), 12.4), -1))
    pixels, disparity = matched(method, lower, upper, middle())
    assert len(pixels) > 800
    assert abs(np.median(disparity) - 12.4) < 0.05
    assert np.mean(np.abs(disparity - 12.4) < 0.25) > 0.95


@pytest.mark.parametrize("method", METHODS)
def test_leaves_out_pixels_without_a_match(method: str) -> None:
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
def test_finds_two_depths_side_by_side(method: str) -> None:
    """A near wall on the right, a far one on the left."""
    lower = texture(11, SHAPE)
    upper = np.where(np.arange(SHAPE[1]) < 120, np.roll(lower, 8, axis=0), np.roll(lower, 31, axis=0))
    pixels, disparity = matched(method, lower, upper, middle())
    columns = pixels % SHAPE[1]
    for side, expected in ((columns < 105, 8), (columns > 135, 31)):
        assert side.sum() > 250
        assert np.mean(np.abs(disparity[side] - expected) < 0.3) > 0.95


def test_the_search_follows_columns_that_have_moved() -> None:
    """A pair that was not exposed at once: near points appear aside in the upper panorama, by a known shift."""
    lower, aside_px = texture(21, SHAPE, 1.2), 2.0
    upper = np.roll(turned(lower, aside_px), SHIFT_PX, axis=0)
    expected = ColumnShift(
        np.full(SHAPE, aside_px / 2, np.float32), np.full(SHAPE, aside_px / 2 / SHIFT_PX, np.float32)
    )
    matcher = Matcher(SHAPE, MatchingSettings(disparities=DISPARITIES))
    errors = [
        np.abs(matcher.match(lower, upper, middle(), column_shift=shift)[1] - SHIFT_PX) for shift in (expected, None)
    ]
    assert len(errors[0]) > 500 and np.mean(errors[0] < 0.2) > 0.85
    assert np.mean(errors[1] < 0.2) < 0.6  # without it
