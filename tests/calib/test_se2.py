"""Poses on the floor: comparison with the transforms of SE(3), and with small steps along an arc."""

from __future__ import annotations

import math

import numpy as np
import pytest

from calib import se3
from calib.se2 import IDENTITY, Pose2, along_arc, composed, relative, seen_from

A, B = Pose2(1.2, -0.7, 2.5), Pose2(-0.3, 0.9, 1.4)


def matrix(pose: Pose2) -> np.ndarray:
    return se3.transform(se3.rotation_exp([0.0, 0.0, pose.yaw_rad]), [pose.x_m, pose.y_m, 0.0])


def test_composition_is_that_of_transforms() -> None:
    np.testing.assert_allclose(matrix(composed(A, B)), matrix(A) @ matrix(B), atol=1e-14)
    assert composed(A, B).yaw_rad == A.yaw_rad + B.yaw_rad  # turns are counted, not wrapped


def test_the_relative_pose_is_what_composition_needs() -> None:
    assert composed(A, relative(A, B)) == pytest.approx(B)
    assert relative(A, A) == IDENTITY


def test_points_are_moved_into_the_axes_of_a_pose() -> None:
    points = [(0.4, -1.1), (A.x_m, A.y_m)]
    expected = se3.apply(se3.inverse(matrix(A)), [(x, y, 0.0) for x, y in points])
    np.testing.assert_allclose(seen_from(A, points), expected[:, :2], atol=1e-14)


@pytest.mark.parametrize("yaw_rate_radps", [0.0, 1e-12, 1e-6, -0.8, 3.0])
def test_an_arc_is_the_limit_of_small_straight_steps(yaw_rate_radps: float) -> None:
    steps, duration_s = 20_000, 1.5
    found = IDENTITY
    for _ in range(steps):
        found = composed(found, Pose2(-0.4 * duration_s / steps, 0.0, yaw_rate_radps * duration_s / steps))
    assert along_arc(-0.4, yaw_rate_radps, duration_s) == pytest.approx(found, abs=1e-4)


def test_half_a_turn_ends_across_the_circle() -> None:
    radius_m = 0.5
    end = along_arc(radius_m, 1.0, math.pi)
    assert end == pytest.approx((0.0, 2 * radius_m, math.pi), abs=1e-15)
