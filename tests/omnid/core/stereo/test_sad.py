"""SAD volume against a literal eq. (1), local minima, subpixel refinement."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from omnid.core.stereo.semiglobal import NO_MATCH, SadVolume, local_minima, subpixel
from tests.omnid.core.scenery import texture

Image = NDArray[np.uint8]

HEIGHT, WIDTH, DISPARITIES, WINDOW_PX = 20, 26, 7, 5
LOWER, UPPER = texture(1, (HEIGHT, WIDTH), 1.0), texture(2, (HEIGHT, WIDTH), 1.0)


def literal_sad(lower: Image, upper: Image, column: int, row: int, disparity: int) -> int:
    """Return eq. (1), computed pixel by pixel."""
    half = WINDOW_PX // 2
    window = range(-half, half + 1)
    return sum(
        abs(int(lower[row + j, column + i]) - int(upper[row + disparity + j, column + i]))
        for i in window
        for j in window
    )


@pytest.fixture(scope="module")
def volume() -> SadVolume:
    filled = SadVolume((HEIGHT, WIDTH), DISPARITIES, WINDOW_PX)
    filled.fill(LOWER, UPPER)
    return filled


def test_planes_are_eq_1(volume: SadVolume) -> None:
    half = WINDOW_PX // 2
    for d in range(DISPARITIES):
        for row in range(half, HEIGHT - half - d):
            for column in range(half, WIDTH - half):
                assert volume.planes[d, row, column] == literal_sad(LOWER, UPPER, column, row, d)


def test_rows_below_the_image_have_no_match(volume: SadVolume) -> None:
    for d in range(1, DISPARITIES):
        assert (volume.planes[d, -d:] == NO_MATCH).all()
        assert (volume.planes[d, :-d] < NO_MATCH).all()


def test_filling_again_replaces_the_last_pair(volume: SadVolume) -> None:
    again = SadVolume((HEIGHT, WIDTH), DISPARITIES, WINDOW_PX)
    again.fill(UPPER, LOWER)
    again.fill(LOWER, UPPER)
    np.testing.assert_array_equal(again.planes, volume.planes)


def test_the_largest_window_does_not_overflow() -> None:
    volume = SadVolume((20, 20), 2, 15)
    volume.fill(np.zeros((20, 20), np.uint8), np.full((20, 20), 255, np.uint8))
    assert volume.planes[0, 10, 10] == 15 * 15 * 255


def test_costs_of_chosen_pixels(volume: SadVolume) -> None:
    pixels = np.array([0, 77, HEIGHT * WIDTH - 1])
    np.testing.assert_array_equal(volume.at(pixels), volume.planes.reshape(DISPARITIES, -1)[:, pixels])


def test_costs_around_a_disparity_are_no_match_outside_the_range(volume: SadVolume) -> None:
    pixels, disparity = np.array([30, 77, 100, 140]), np.array([3, 0, 6, 1])
    around = volume.around(pixels, disparity, 2)
    for n, (pixel, d) in enumerate(zip(pixels, disparity, strict=True)):
        expected = [volume.planes[k].flat[pixel] if 0 <= k < DISPARITIES else NO_MATCH for k in range(d - 2, d + 3)]
        np.testing.assert_array_equal(around[:, n], expected)


def test_best_from_upper_searches_all_disparities(volume: SadVolume) -> None:
    rows, columns = np.meshgrid(np.arange(2, HEIGHT - DISPARITIES), np.arange(2, WIDTH - 2), indexing="ij")
    pixels = (rows * WIDTH + columns).ravel()
    disparity = np.random.default_rng(3).integers(0, DISPARITIES, len(pixels))
    chosen = volume.best_from_upper(pixels, disparity)
    for pixel, d, choice, cost in zip(pixels, disparity, *chosen, strict=True):
        row, column = divmod(pixel + d * WIDTH, WIDTH)
        costs = [volume.planes[k, row - k, column] if row >= k else NO_MATCH for k in range(DISPARITIES)]
        assert choice == int(np.argmin(costs)) and cost == min(costs)


def test_minima_lie_inside_the_range_and_below_the_limit() -> None:
    costs = np.array([[1, 9, 9, 7], [5, 4, 3, 7], [2, 6, 3, 7], [6, 2, 8, 7], [1, 8, 9, 7]], np.uint16)
    expected = np.zeros(costs.shape, bool)
    expected[2, 0] = expected[1, 1] = expected[3, 1] = expected[1, 2] = True
    np.testing.assert_array_equal(local_minima(costs, 100), expected)
    np.testing.assert_array_equal(
        local_minima(costs, np.array([1, 2, 3, 9], np.uint16)), expected & (costs <= [1, 2, 3, 9])
    )


@pytest.mark.parametrize("fraction", [-0.45, -0.2, 0.0, 0.3, 0.5])
def test_subpixel_is_exact_for_a_v(fraction: float) -> None:
    steps = np.arange(7)[:, None]
    costs = np.rint(40 + 1000 * np.abs(steps - (3 + fraction))).astype(np.uint16)
    assert subpixel(costs, np.array([3]))[0] == pytest.approx(3 + fraction, abs=0.002)


def test_subpixel_stays_within_half_a_pixel() -> None:
    flat = np.full((5, 1), 7, np.uint16)
    assert subpixel(flat, np.array([2]))[0] == 2
    assert subpixel(np.array([[60000], [50], [60], [70]], np.uint16), np.array([2]))[0] == 1.5
