"""Differences between series of two recorded runs."""

from __future__ import annotations

import numpy as np

from calib import se3
from omnid.recordings.series_differences import Series, gaps, pose_excess


def test_finds_gaps() -> None:
    whole, other = (Series(np.array(stamps), np.zeros((len(stamps), 1))) for stamps in ([1, 2, 3, 4, 5, 6], [2, 5]))
    found = gaps(whole, other)
    assert (found.missing, found.stretches, found.longest, found.longest_ns) == (4, 3, 2, 3)
    assert gaps(other, whole).missing == 0


def test_small_angles_are_exact() -> None:
    stamps = np.array([1, 2])
    angles = (1e-9, 1e-4)
    a = Series(stamps, np.tile([0, 0, 0, *se3.quaternion(se3.rotation_exp((0.4, -2.0, 1.0)))], (2, 1)))
    turned = [se3.quaternion(se3.rotation_exp((0.4, -2.0, 1.0)) @ se3.rotation_exp((0, angle, 0))) for angle in angles]
    b = Series(stamps, np.array([[0, 0, 0, *q] for q in turned]))
    np.testing.assert_allclose(pose_excess(a, b, 0, 0).amounts[:, 1], angles, rtol=1e-5)
    assert pose_excess(a, a, 0, 0).first_different is None
