"""The path that was driven, as the topic `path`: at most MOST_POSES poses of the base in odom."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from calib import se3
from omnid.core.mapping.thinned_path import ThinnedPath
from omnid.messages import OdometryUpdate
from omnid.sinks.encoder import Encoder, OutgoingMessage
from omnid.transport.navigation_codec import PATH_SCHEMA, driven_path_cdr

MOST_POSES: Final = 1000
_STEP_M: Final = 0.05  # First spacing of the poses; it is doubled each time that the memory is full.
_COS_HALF_TURN: Final = float(np.cos(np.radians(5.0)))  # a turn by 10 degrees is a step as well
_PERIOD_NS: Final = 10**9


class _Vertex(NamedTuple):
    stamp_ns: int
    pose: NDArray[np.float64]  # (7,) x y z [m], quaternion x y z w


def _is_step(last: _Vertex, new: _Vertex, step_m: float) -> bool:
    has_moved = np.linalg.norm(new.pose[:3] - last.pose[:3]) >= step_m
    return bool(has_moved or abs(new.pose[3:] @ last.pose[3:]) < _COS_HALF_TURN)


class DrivenPath:
    """Yields the path each second in which it has grown; each call adds a pose.

    s_per_pose: time between two messages for each pose in them, so that the paths of a long recording stay a small
    part of it: 80 bytes in 0.02 s are 4 kB/s.
    """

    def __init__(self, encode: Encoder, s_per_pose: float = 0.0) -> None:
        self._encode, self._ns_per_pose = encode, 1e9 * s_per_pose
        self._path = ThinnedPath(MOST_POSES, _STEP_M, _is_step)
        self._has_grown = False  # since the last message
        self._newest_ns, self._due_ns = 0, 0

    def __call__(self, odometry: OdometryUpdate) -> Iterator[OutgoingMessage]:
        """Add the pose where the base has moved; yield the path when it is due."""
        stamp_ns = odometry.stamp_ns + self._encode.offset_ns
        T_base_rig = self._encode.T_base_rig
        T = T_base_rig @ odometry.T_odom_rig @ se3.inverse(T_base_rig)
        pose = np.concatenate([T[:3, 3], se3.quaternion(T[:3, :3])])
        self._newest_ns = stamp_ns
        self._has_grown |= self._path.add(_Vertex(stamp_ns, pose))
        if stamp_ns >= self._due_ns:
            yield from self.finish()

    def finish(self) -> Iterator[OutgoingMessage]:
        """Yield the path if it has grown since the last message."""
        if not self._has_grown:
            return
        self._has_grown = False
        vertices = self._path.vertices
        self._due_ns = self._newest_ns + max(_PERIOD_NS, round(self._ns_per_pose * len(vertices)))
        stamps_ns = np.array([vertex.stamp_ns for vertex in vertices], np.int64)
        payload = driven_path_cdr(self._newest_ns, stamps_ns, np.array([vertex.pose for vertex in vertices]))
        yield OutgoingMessage("path", PATH_SCHEMA, payload)
