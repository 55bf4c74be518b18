"""Motion since the last accepted pose, while poses are refused: how fast it may be, and what else explains a pose.

The speed is unknown, and the position's sigma grows with it. A pose that is refused for its speed alone may be right,
because the vehicle may be faster than its limit says. Where the map is found again after that, two motions explain it:
the vehicle is there, or it has gone on at that speed, to a place that looks like this one. So the second is the
runner-up of the first (runner_up_motions.py), and stays in the covariance: later steps show both alike.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from omnid.core.odometry.estimates import GapStep, PoseEstimate

Array = NDArray[np.float64]

# Sigma of the velocity while poses are refused [m/s, rad/s], because indoor vehicles are seldom faster than twice that.
UNTRACKED_SPEED_SIGMA = 0.5


@dataclass(frozen=True, slots=True)
class UntrackedMotion:
    """Motion since the last accepted pose."""

    T_at_fix: Array  # (4, 4) that pose
    too_fast: Array = field(default_factory=lambda: np.zeros(3))  # [m/s] in odom: that of the fastest refused pose

    @property
    def sigma(self) -> Array:
        """Standard deviation (6,) of the velocity [m/s, rad/s]."""
        return np.repeat([max(UNTRACKED_SPEED_SIGMA, float(np.linalg.norm(self.too_fast))), UNTRACKED_SPEED_SIGMA], 3)

    def keeps_view(self, T_odom_rect: Array) -> bool:
        """Return whether a pose (4, 4) has the same landmarks in view as the last accepted one."""
        return GapStep.between(self.T_at_fix, T_odom_rect).keeps_view

    def refused(self, T_odom_rect: Array, since_s: float) -> UntrackedMotion:
        """Return the motion after a pose that was refused for its speed, since_s after the last accepted one."""
        velocity = (T_odom_rect[:3, 3] - self.T_at_fix[:3, 3]) / since_s
        return replace(self, too_fast=max(self.too_fast, velocity, key=lambda v: float(np.linalg.norm(v))))

    def in_doubt(self, estimate: PoseEstimate, since_s: float) -> PoseEstimate:
        """Return an estimate with the motion at the refused speed as its runner-up, if there was one."""
        if not self.too_fast.any():
            return estimate
        aside = self.T_at_fix[:3, 3] + self.too_fast * since_s - estimate.T_odom_rect[:3, 3]
        other = np.concatenate([estimate.T_odom_rect[:3, :3].T @ aside, np.zeros(3)])
        return replace(estimate, runner_up=max((other, estimate.runner_up), key=_length), through_gap=True)


def _length(step: Array | None) -> float:
    return 0.0 if step is None else float(np.linalg.norm(step[:3]))
