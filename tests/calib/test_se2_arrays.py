"""Arrays of poses on the floor: the same results as single poses and as transforms."""

from __future__ import annotations

import math

import numpy as np

from calib import se2, se3
from calib.se2_arrays import composed, planar, predicted, relative, transform, wrapped

POSES = np.random.default_rng(5).uniform(-3, 3, (20, 3))
STEP = np.array([0.4, -0.2, 1.1])


def pose(values: np.ndarray) -> se2.Pose2:
    return se2.Pose2(*values.tolist())


def test_composition_is_that_of_single_poses() -> None:
    single = [se2.composed(pose(each), pose(STEP)) for each in POSES]
    np.testing.assert_allclose(composed(POSES, STEP), single, atol=1e-14)
    pairs = [se2.composed(pose(a), pose(b)) for a, b in zip(POSES, POSES[::-1], strict=True)]
    np.testing.assert_allclose(composed(POSES, POSES[::-1]), pairs, atol=1e-14)


def test_relative_inverts_composition() -> None:
    for each in POSES:
        np.testing.assert_allclose(relative(each, composed(each[None], STEP)[0]), STEP, atol=1e-14)


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
    np.testing.assert_allclose(predicted(POSES[0], 0.5, -0.7, 0.4), composed(POSES[:1], arc)[0], atol=1e-14)
