"""Frames of the robot, and the motion of the base that carries the rig. p_a = T_a_b @ p_b.

    map ---- odom ---- base ---- rig ---- rect

map, odom: fixed to the world; T_map_odom carries the corrections (REP 105). base: x forward, y left, z up, on the
ground below the robot (REP 103). rig: the frame in which the cameras were calibrated. rect: the rectified frame, at the
lower viewpoint with z towards the upper one, in which epipolar lines are columns of the panoramas.

The covariance of a pose T_a_b is body-fixed: of a small motion [t; r] of b in the axes of b. Messages of ROS have it in
the axes of a; it is converted where a message is encoded: `in_outer_axes`.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from calib import se3

Array = NDArray[np.float64]


class BaseMotion(NamedTuple):
    """Pose and velocity of the base; odom is here the base's frame at the first pair."""

    T_odom_base: Array  # (4, 4)
    covariance: Array  # (6, 6) [t; r] in the axes of the base
    velocity: Array  # (6,) m/s, rad/s in the base frame
    velocity_covariance: Array  # (6, 6)


def in_outer_axes(T_a_b: Array, covariance: Array) -> Array:
    """Return the body-fixed covariance (6, 6) [t; r] of a pose T_a_b in the axes of a (nav_msgs/msg/Odometry)."""
    R = np.zeros((6, 6))
    R[:3, :3] = R[3:, 3:] = T_a_b[:3, :3]
    return np.asarray(R @ covariance @ R.T)


def base_pose(T_odom_rig: Array, covariance: Array, T_base_rig: Array) -> tuple[Array, Array]:
    """Return T_odom_base and its body-fixed covariance, for those of the rig; the same for a pose in the map."""
    A = se3.adjoint(T_base_rig)
    return T_base_rig @ T_odom_rig @ se3.inverse(T_base_rig), A @ covariance @ A.T
