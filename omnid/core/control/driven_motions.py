"""Motions that the base has followed, and the pose to which they lead.

Plain Python: it runs in the process that steers.
"""

from __future__ import annotations

from collections import deque
from typing import Final

from calib.se2 import IDENTITY, Pose2, along_arc, composed
from omnid.core.control.heading_controller import Twist
from omnid.core.nanoseconds import S_PER_NS

MOST_MOTIONS: Final = 400  # remembered between a ring's images and now: 2 s at the highest rate of ticks


class DrivenMotions:
    """The newest MOST_MOTIONS motions, each from its stamp until that of the next one."""

    def __init__(self) -> None:
        self._motions: deque[tuple[int, Twist]] = deque(maxlen=MOST_MOTIONS)

    def add(self, now_ns: int, motion: Twist) -> None:
        """Take the motion that the base follows from now on."""
        self._motions.append((now_ns, motion))

    def reach_back_to(self, stamp_ns: int) -> bool:
        """True if no motion after a stamp was forgotten."""
        return len(self._motions) < MOST_MOTIONS or self._motions[0][0] <= stamp_ns

    def since(self, stamp_ns: int, now_ns: int) -> Pose2:
        """Return the pose of the base now, in its own frame at a stamp."""
        # 1. The motions since the stamp and their durations, newest first.
        pieces, until_ns = [], now_ns
        for at_ns, motion in reversed(self._motions):
            begin_ns = max(at_ns, stamp_ns)
            if until_ns > begin_ns:
                pieces.append((motion, (until_ns - begin_ns) * S_PER_NS))
            until_ns = min(until_ns, begin_ns)
            if at_ns <= stamp_ns:
                break
        # 2. The poses along them, oldest first.
        pose = IDENTITY
        for motion, dt_s in reversed(pieces):
            pose = composed(pose, along_arc(motion.velocity_mps, motion.yaw_rate_radps, dt_s))
        return pose
