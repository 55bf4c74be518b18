"""The path that was driven, as the topic `path`: at most MOST_POSES poses of the base in odom."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Final

import numpy as np
from numpy.typing import NDArray

from calib import se3
from omnid.messages import OdometryUpdate
from omnid.sinks.encoder import Encoder, OutgoingMessage
from omnid.transport.navigation_codec import PATH_SCHEMA
from omnid.transport.path_codec import driven_path_cdr

MOST_POSES: Final = 1000
_STEP_M: Final = 0.05  # between two poses at first; twice as much each time that the memory is full
_COS_HALF_TURN: Final = float(np.cos(np.radians(5.0)))  # a turn by 10 degrees is a step as well
_PERIOD_NS: Final = 10**9


class DrivenPath:
    """Yields the path each second in which it has grown; each call adds a pose.

    s_per_pose: time between two messages for each pose in them, so that the paths of a long recording stay a small
    part of it: 80 bytes in 0.02 s are 4 kB/s.
    """

    def __init__(self, encode: Encoder, s_per_pose: float = 0.0) -> None:
        self._encode, self._ns_per_pose = encode, 1e9 * s_per_pose
        self._stamps_ns = np.zeros(MOST_POSES, np.int64)
        self._poses = np.zeros((MOST_POSES, 7))  # x y z [m], quaternion x y z w
        self._kept, self._step_m = 0, _STEP_M
        self._added, self._given = 0, 0  # poses since the start: all, those before the last message
        self._newest_ns, self._due_ns = 0, 0

    def __call__(self, odometry: OdometryUpdate) -> Iterator[OutgoingMessage]:
        """Add the pose where the base has moved; yield the path when it is due."""
        stamp_ns = odometry.stamp_ns + self._encode.offset_ns
        T_base_rig = self._encode.T_base_rig
        T = T_base_rig @ odometry.T_odom_rig @ se3.inverse(T_base_rig)
        pose = np.concatenate([T[:3, 3], se3.quaternion(T[:3, :3])])
        self._newest_ns = stamp_ns
        if self._kept == 0 or self._has_moved(pose):
            self._add(stamp_ns, pose)
        if stamp_ns >= self._due_ns:
            yield from self.finish()

    def finish(self) -> Iterator[OutgoingMessage]:
        """Yield the path if it has grown since the last message."""
        if self._given == self._added:
            return
        self._given = self._added
        self._due_ns = self._newest_ns + max(_PERIOD_NS, round(self._ns_per_pose * self._kept))
        payload = driven_path_cdr(self._newest_ns, self._stamps_ns[: self._kept], self._poses[: self._kept])
        yield OutgoingMessage("path", PATH_SCHEMA, payload)

    def _has_moved(self, pose: NDArray[np.float64]) -> bool:
        last = self._poses[self._kept - 1]
        return bool(np.linalg.norm(pose[:3] - last[:3]) >= self._step_m or abs(pose[3:] @ last[3:]) < _COS_HALF_TURN)

    def _add(self, stamp_ns: int, pose: NDArray[np.float64]) -> None:
        if self._kept == MOST_POSES:  # every second one is dropped
            self._kept, self._step_m = MOST_POSES // 2, 2 * self._step_m
            for kept in (self._stamps_ns, self._poses):
                kept[: self._kept] = kept[1::2].copy()
        self._stamps_ns[self._kept], self._poses[self._kept] = stamp_ns, pose
        self._kept += 1
        self._added += 1
