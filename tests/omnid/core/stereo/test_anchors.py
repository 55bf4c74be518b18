"""Choosing among candidates by lines to anchors: line differences, propagation of anchors, points left undecided."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from omnid.core.stereo.anchors import AnchorPropagation, Candidates, line_difference
from tests.omnid.core.scenery import texture

Flags = NDArray[np.bool_]
Indices = NDArray[np.intp]

SHAPE, SHIFT_PX, COURSE_PX = (160, 640), 20, 12


def lines(*ends: tuple[float, float, float]) -> NDArray[np.float32]:
    return np.array(ends, np.float32).T


def test_line_difference_is_the_mean_of_the_pixels_on_the_line() -> None:
    lower, upper = texture(13, SHAPE), texture(14, SHAPE)
    start, end = lines((10, 20, 10)), lines((42, 84, 22))
    along = (np.arange(32) + 0.5) / 32
    picked = []
    for image, first, last in ((lower, (10, 20), (42, 84)), (upper, (10, 30), (42, 106))):
        column, row = (np.array(first) + along[:, None] * (np.array(last) - first)).T
        c, r = column.astype(int), row.astype(int)
        u, v = column - c, row - r
        picked.append(
            (image[r, c] * (1 - u) + image[r, c + 1] * u) * (1 - v)
            + (image[r + 1, c] * (1 - u) + image[r + 1, c + 1] * u) * v
        )
    expected = np.abs(picked[0] - picked[1]).mean()
    assert line_difference((lower, upper), start, end, 32)[0] == pytest.approx(expected, abs=1.0)


def courses() -> tuple[NDArray[np.uint8], NDArray[np.uint8]]:
    """A wall of courses that look alike, and the same SHIFT_PX lower."""
    course = texture(1, (COURSE_PX * 3, SHAPE[1]), 2.0)[COURSE_PX : 2 * COURSE_PX]
    wall = np.tile(course, (SHAPE[0] // COURSE_PX + 3, 1))
    return wall[SHIFT_PX : SHIFT_PX + SHAPE[0]], wall[: SHAPE[0]]


def grid_of_pixels() -> Indices:
    rows, columns = np.meshgrid(np.arange(30, 110, 5), np.arange(6, SHAPE[1] - 6, 5), indexing="ij")
    return np.asarray((rows * SHAPE[1] + columns).ravel())


def propagated(sure: Flags, pixels: Indices) -> tuple[Indices, Flags]:
    """All but the sure points have equally good candidates one course apart, and start with a wrong one."""
    true = np.array([SHIFT_PX + k * COURSE_PX for k in (-1, 0, 1, 2)])
    several = np.flatnonzero(~sure)
    point, disparity = np.repeat(several, 4), np.tile(true, len(several))
    propagation = AnchorPropagation(courses(), pixels, np.where(sure, SHIFT_PX, true[0]))
    clear = propagation.propagate(sure, Candidates(point, disparity, np.ones(len(point), np.float32)))
    return propagation.disparity, clear


def test_a_few_anchors_at_one_end_decide_the_whole_wall() -> None:
    pixels = grid_of_pixels()
    sure = pixels % SHAPE[1] < 12
    disparity, clear = propagated(sure, pixels)
    assert clear[~sure].mean() > 0.9
    assert np.mean(disparity[clear] == SHIFT_PX) > 0.98
