"""Poses on the floor, as floats and in arrays."""

from __future__ import annotations

import math

import numpy as np
import pytest

from calib import se2, se2_arrays, se3
from calib.se2 import IDENTITY, Pose2, along_arc, composed, relative, seen_from
from calib.se2_arrays import planar, predicted, transform, wrapped

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


POSES = np.random.default_rng(5).uniform(-3, 3, (20, 3))
STEP = np.array([0.4, -0.2, 1.1])


def pose(values: np.ndarray) -> se2.Pose2:
    return se2.Pose2(*values.tolist())


def test_composition_is_that_of_single_poses() -> None:
    single = [se2.composed(pose(each), pose(STEP)) for each in POSES]
    np.testing.assert_allclose(se2_arrays.composed(POSES, STEP), single, atol=1e-14)
    pairs = [se2.composed(pose(a), pose(b)) for a, b in zip(POSES, POSES[::-1], strict=True)]
    np.testing.assert_allclose(se2_arrays.composed(POSES, POSES[::-1]), pairs, atol=1e-14)


def test_relative_inverts_composition() -> None:
    for each in POSES:
        np.testing.assert_allclose(
            se2_arrays.relative(each, se2_arrays.composed(each[None], STEP)[0]), STEP, atol=1e-14
        )


def test_a_transform_and_its_pose_are_inverse() -> None:
    for each in POSES:
        np.testing.assert_allclose(planar(transform(each)), each, atol=1e-14)
        assert se3.is_rigid(transform(each), 1e-15)
    tilted = transform(POSES[0]) @ se3.transform(se3.rotation_exp([0.1, 0.0, 0.0]), [0.0, 0.0, 2.0])
    np.testing.assert_allclose(planar(tilted), POSES[0], atol=1e-14)


def test_angles_are_wrapped_into_one_turn() -> None:
    turns = 2 * math.pi * np.arange(-3, 4)
    np.testing.assert_allclose(wrapped(0.3 + turns), 0.3, atol=1e-14)
    assert wrapped(np.array(math.pi)) == -math.pi


def test_a_pose_is_predicted_along_the_arc() -> None:
    arc = np.array(se2.along_arc(0.5, -0.7, 0.4))
    np.testing.assert_allclose(predicted(POSES[0], 0.5, -0.7, 0.4), se2_arrays.composed(POSES[:1], arc)[0], atol=1e-14)
