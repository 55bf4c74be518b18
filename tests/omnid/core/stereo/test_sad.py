"""SAD volume against a literal eq. (1), local minima, subpixel refinement."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from omnid.core.stereo.semiglobal import SadVolume, subpixel
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


def test_the_largest_window_does_not_overflow() -> None:
    volume = SadVolume((20, 20), 2, 15)
    volume.fill(np.zeros((20, 20), np.uint8), np.full((20, 20), 255, np.uint8))
    assert volume.planes[0, 10, 10] == 15 * 15 * 255


@pytest.mark.parametrize("fraction", [-0.45, -0.2, 0.0, 0.3, 0.5])
def test_subpixel_is_exact_for_a_v(fraction: float) -> None:
    steps = np.arange(7)[:, None]
    costs = np.rint(40 + 1000 * np.abs(steps - (3 + fraction))).astype(np.uint16)
    assert subpixel(costs, np.array([3]))[0] == pytest.approx(3 + fraction, abs=0.002)
