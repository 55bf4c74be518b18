"""Compiled RANSAC on three points."""

from __future__ import annotations

import numpy as np

from omnid.core.odometry.ransac_kernels import triple


def test_triples_are_of_different_landmarks_each_as_often() -> None:
    count, state = np.zeros((4, 4, 4), int), np.uint64(7)
    with np.errstate(over="ignore"):
        for _ in range(2400):
            a, b, c, state = triple(4, state)
            count[a, b, c] += 1
    assert (count > 0).sum() == 24 and count[count > 0].min() > 60 and count.max() < 140
