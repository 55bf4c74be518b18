"""Poses on the floor (x, y, yaw) [m, m, rad] in arrays (3,) or (N, 3), transforms, and distances; floats: `se2.py`."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from calib import se3
from calib.se2 import Pose2, along_arc
from calib.se2 import composed as composed_pose
from calib.se2 import relative as relative_pose

Array = NDArray[np.float64]


def wrapped(angle: Array) -> Array:
    """Return angles in [-pi, pi)."""
    return np.asarray((angle + math.pi) % (2 * math.pi) - math.pi)


def planar(T: Array) -> Array:
    """Return x, y, yaw (3,) of a transform (4, 4)."""
    return np.array([T[0, 3], T[1, 3], math.atan2(T[1, 0], T[0, 0])])


def transform(pose: Array) -> Array:
    """Return the transform (4, 4) of x, y, yaw (3,)."""
    c, s = math.cos(pose[2]), math.sin(pose[2])
    return se3.transform([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]], [pose[0], pose[1], 0.0])


def composed(poses: Array, step: Array) -> Array:
    """Return poses (N, 3) after a motion (3,) or motions (N, 3) in their own axes."""
    c, s = np.cos(poses[:, 2]), np.sin(poses[:, 2])
    dx, dy, turn = step.T
    return np.column_stack([poses[:, 0] + c * dx - s * dy, poses[:, 1] + s * dx + c * dy, poses[:, 2] + turn])


def relative(a: Array, b: Array) -> Array:
    """Return the pose (3,) of b in the axes of a."""
    return np.array(relative_pose(Pose2(*a.tolist()), Pose2(*b.tolist())))


def predicted(pose: Array, velocity_mps: float, yaw_rate_radps: float, duration_s: float) -> Array:
    """Return the pose (3,) after a time at constant speeds."""
    return np.array(composed_pose(Pose2(*pose.tolist()), along_arc(velocity_mps, yaw_rate_radps, duration_s)))


def from_segments_m(points: Array, begin: Array, end: Array) -> Array:
    """Return the distances (N, K) [m] of points (N, 2) from segments between (K, 2), or between (N, K, 2)."""
    along, to = end - begin, points[:, None] - begin
    share = np.clip((to * along).sum(axis=-1) / np.maximum((along**2).sum(axis=-1), 1e-9), 0.0, 1.0)
    return np.asarray(np.linalg.norm(to - share[..., None] * along, axis=-1))
