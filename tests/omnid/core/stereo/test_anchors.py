"""Choosing among candidates by lines to anchors, which are propagated along a wall of equal courses."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from omnid.core.stereo.anchors import AnchorPropagation, Candidates
from tests.omnid.core.scenery import texture

Flags = NDArray[np.bool_]
Indices = NDArray[np.intp]

SHAPE, SHIFT_PX, COURSE_PX = (160, 640), 20, 12


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
