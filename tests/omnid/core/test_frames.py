"""Frames of the robot, and the motion of the base that carries the rig."""

from __future__ import annotations

from typing import Any, cast

import numpy as np

from calib import se3
from omnid.core.frames import in_outer_axes
from omnid.messages import OdometryUpdate
from omnid.tracking_state import TrackingState


def odometry(T: np.ndarray, covariance: np.ndarray) -> OdometryUpdate:
    velocity, depth = np.array([1.0, 2, 3, 0.1, 0.2, 0.3]), cast("Any", None)
    return OdometryUpdate(0, 0, T, covariance, velocity, np.zeros((6, 6)), TrackingState.TRACKING, 0, 0, 0, depth)


def test_covariance_of_the_base_equals_the_scatter_of_its_motions() -> None:
    """Random small motions of the rig, transformed to the base, scatter by the covariance of the base."""
    rng = np.random.default_rng(0)
    T_odom_rig, T_base_rig = se3.exp(rng.normal(0, 1, 6)), se3.exp(rng.normal(0, 1, 6))
    root = rng.normal(0, 1e-4, (6, 6))
    T_odom_base, of_body, velocity, _ = odometry(T_odom_rig, root @ root.T).of_base(T_base_rig)
    covariance = in_outer_axes(T_odom_base, of_body)
    small = se3.exp(rng.normal(0, 1, (100_000, 6)) @ root.T)
    moved = T_base_rig @ (T_odom_rig @ small) @ se3.inverse(T_base_rig)
    shift = moved[:, :3, 3] - T_odom_base[:3, 3]
    turn = se3.rotation_log(moved[:, :3, :3] @ T_odom_base[:3, :3].T)
    spread = np.cov(np.hstack([shift, turn]).T)
    assert np.abs(spread - covariance).max() < 0.03 * np.abs(covariance).max()
    ahead = se3.exp(np.array([1.0, 2, 3, 0.1, 0.2, 0.3]) * 1e-6)
    base_moved = T_base_rig @ ahead @ se3.inverse(T_base_rig)
    np.testing.assert_allclose(se3.log(base_moved) / 1e-6, velocity, rtol=1e-4)


def test_base_starts_at_the_origin() -> None:
    T_base_rig = se3.exp([0.1, 0.2, 0.3, 0.4, 0.5, 0.6])
    np.testing.assert_allclose(odometry(np.eye(4), np.eye(6)).of_base(T_base_rig)[0], np.eye(4), atol=1e-12)
