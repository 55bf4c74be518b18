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


class BodyMotion(NamedTuple):
    """Pose and velocity of a frame on the body of the robot: rect, rig or base. odom is that frame at the start."""

    T_odom_b: Array  # (4, 4)
    covariance: Array  # (6, 6) [t; r] of the pose in the axes of the frame
    velocity: Array  # (6,) m/s, rad/s in the frame
    velocity_covariance: Array  # (6, 6)

    def of(self, T_c_b: Array) -> BodyMotion:
        """Return the motion of another frame c on the same body."""
        A = se3.adjoint(T_c_b)
        pose = carried(self.T_odom_b, self.covariance, T_c_b)
        return BodyMotion(*pose, A @ self.velocity, A @ self.velocity_covariance @ A.T)


def carried(T_a_b: Array, covariance: Array, T_c_b: Array) -> tuple[Array, Array]:
    """Return the pose, and its covariance, of another frame c on the body of b; a is where either of them began."""
    A = se3.adjoint(T_c_b)
    return T_c_b @ T_a_b @ se3.inverse(T_c_b), A @ covariance @ A.T


def in_outer_axes(T_a_b: Array, covariance: Array) -> Array:
    """Return the body-fixed covariance (6, 6) [t; r] of a pose T_a_b in the axes of a (nav_msgs/msg/Odometry)."""
    R = np.zeros((6, 6))
    R[:3, :3] = R[3:, 3:] = T_a_b[:3, :3]
    return np.asarray(R @ covariance @ R.T)
