"""Sums of absolute differences against a literal eq. (1), and the refinement of their minimum."""

from __future__ import annotations

import numpy as np
import pytest

from omnid.core.stereo.sad import sad, subpixel
from tests.omnid.core.scenery import texture

HEIGHT, WIDTH, WINDOW_PX = 20, 26, 5


def test_the_sum_is_eq_1() -> None:
    half, lower, upper = WINDOW_PX // 2, *(texture(seed, (HEIGHT, WIDTH), 1.0) for seed in (1, 2))
    found = sad(lower, upper, WINDOW_PX)
    for row in range(half, HEIGHT - half):
        for column in range(half, WIDTH - half):
            part = slice(row - half, row + half + 1), slice(column - half, column + half + 1)
            assert found[row, column] == np.abs(lower[part].astype(int) - upper[part].astype(int)).sum()


def test_the_largest_window_does_not_overflow() -> None:
    found = sad(np.zeros((20, 20), np.uint8), np.full((20, 20), 255, np.uint8), 15)
    assert found[10, 10] == 15 * 15 * 255


@pytest.mark.parametrize("fraction", [-0.45, -0.2, 0.0, 0.3, 0.5])
def test_subpixel_is_exact_for_a_v(fraction: float) -> None:
    steps = np.arange(7)[:, None]
    costs = np.rint(40 + 1000 * np.abs(steps - (3 + fraction))).astype(np.uint16)
    assert subpixel(costs, np.array([3]))[0] == pytest.approx(3 + fraction, abs=0.002)
