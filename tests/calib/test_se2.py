"""Poses on the floor, as floats and in arrays."""

from __future__ import annotations

import numpy as np
import pytest

from calib import se2, se2_arrays, se3
from calib.se2 import IDENTITY, Pose2, along_arc, composed

A, B = Pose2(1.2, -0.7, 2.5), Pose2(-0.3, 0.9, 1.4)


def matrix(pose: Pose2) -> np.ndarray:
    return se3.transform(se3.rotation_exp([0.0, 0.0, pose.yaw_rad]), [pose.x_m, pose.y_m, 0.0])


def test_composition_is_that_of_transforms() -> None:
    np.testing.assert_allclose(matrix(composed(A, B)), matrix(A) @ matrix(B), atol=1e-14)
    assert composed(A, B).yaw_rad == A.yaw_rad + B.yaw_rad  # turns are counted, not wrapped


@pytest.mark.parametrize("yaw_rate_radps", [0.0, 1e-12, 1e-6, -0.8, 3.0])
def test_an_arc_is_the_limit_of_small_straight_steps(yaw_rate_radps: float) -> None:
    steps, duration_s = 20_000, 1.5
    found = IDENTITY
    for _ in range(steps):
        found = composed(found, Pose2(-0.4 * duration_s / steps, 0.0, yaw_rate_radps * duration_s / steps))
    assert along_arc(-0.4, yaw_rate_radps, duration_s) == pytest.approx(found, abs=1e-4)


POSES = np.random.default_rng(5).uniform(-3, 3, (20, 3))
STEP = np.array([0.4, -0.2, 1.1])


def pose(values: np.ndarray) -> se2.Pose2:
    return se2.Pose2(*values.tolist())


def test_relative_inverts_composition() -> None:
    for each in POSES:
        np.testing.assert_allclose(
            se2_arrays.relative(each, se2_arrays.composed(each[None], STEP)[0]), STEP, atol=1e-14
        )
