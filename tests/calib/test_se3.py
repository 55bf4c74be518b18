"""Poses on the floor and rigid transforms."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from calib import se2, se2_arrays, se3
from calib.se2 import IDENTITY, Pose2, along_arc, composed

AXIS = np.array([0.48, -0.6, 0.64])
ANGLES = [0.0, 1e-12, 1e-8, 9.9e-5, 1.01e-4, 0.01, 0.09, 0.3, 2.0, np.pi - 1e-3, np.pi - 1e-7, np.pi - 1e-10]


@pytest.mark.parametrize("angle", ANGLES)
def test_exp_equals_opencv_rodrigues_and_log_inverts_it(angle: float) -> None:
    R = se3.rotation_exp(AXIS * angle)
    np.testing.assert_allclose(R, cv2.Rodrigues(AXIS * angle)[0], rtol=0, atol=1e-14)
    np.testing.assert_allclose(se3.rotation_log(R), AXIS * angle, rtol=0, atol=1e-12)


@pytest.mark.parametrize("axis", [*np.eye(3), AXIS, [0.6, 0.8, 0], [1e-9, 0.6, -0.8]])
def test_the_log_of_a_rotation_by_pi_has_its_axis_and_angle(axis: list[float]) -> None:
    R = 2 * np.outer(axis, axis) - np.eye(3)
    w = se3.rotation_log(R)
    assert np.linalg.norm(w) == pytest.approx(np.pi, abs=1e-12)
    assert abs(w @ axis) == pytest.approx(np.pi, abs=1e-8)


def test_quaternions_are_x_y_z_w_with_w_above_zero() -> None:
    quarter_left = [[0, -1, 0], [1, 0, 0], [0, 0, 1]]
    np.testing.assert_allclose(se3.quaternion(quarter_left), [0, 0, np.sqrt(0.5), np.sqrt(0.5)], rtol=0, atol=1e-15)
    q = np.random.default_rng(0).normal(size=(500, 4))
    q *= np.sign(q[:, 3:]) / np.linalg.norm(q, axis=1, keepdims=True)
    np.testing.assert_allclose(se3.quaternion(se3.rotation(q)), q, rtol=0, atol=1e-9)
    np.testing.assert_allclose(se3.quaternion(se3.rotation(q)[3]), q[3], rtol=0, atol=1e-9)


def test_only_rotations_are_rigid() -> None:
    T = se3.exp([1, 2, 3, 0.1, 0.2, 2.9])
    assert se3.is_rigid(T)
    assert not se3.is_rigid(np.diag([1, 1, -1, 1.0]) @ T)
    assert not se3.is_rigid(1.01 * T)
    assert not se3.is_rigid(np.full((4, 4), np.nan))
    assert not se3.is_rigid(np.eye(3))


@pytest.mark.parametrize("scale", [1e-12, 1e-5, 1e-3, 1.0, 3.0])
def test_a_single_transform_is_that_of_a_stack(scale: float) -> None:
    for axis in (AXIS, -AXIS, np.array([0.0, 0.0, 1.0])):
        twist = np.concatenate([[0.3, -0.2, 0.1], scale * axis])
        T = se3.exp(twist)
        R = T[:3, :3]
        pairs = (
            (T, se3.exp(twist[None])),
            (se3.inverse(T), se3.inverse(T[None])),
            (se3.log(T), se3.log(T[None])),
            (se3.quaternion(R), se3.quaternion(R[None])),
            (se3.rotation_log(R), se3.rotation_log(R[None])),
            (se3.hat(twist[:3]), se3.hat(twist[None, :3])),
            (se3.adjoint(T), se3.adjoint(T[None])),
        )
        for one, (of_stack,) in pairs:
            np.testing.assert_allclose(one, of_stack, rtol=0, atol=1e-14)


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
