"""What a run came to: counts, the way travelled, the states."""

from __future__ import annotations

from collections import Counter

import numpy as np
from numpy.typing import NDArray

from omnid.messages import OdometryUpdate


class RunStatistics:
    """A sink that adds up; other threads may read what it has."""

    def __init__(self) -> None:
        self.poses = 0
        self.length_m = 0.0
        self.states: Counter[str] = Counter()
        self.resets = 0
        self.newest: OdometryUpdate | None = None
        self._position: NDArray[np.float64] | None = None

    def process(self, odometry: OdometryUpdate) -> None:
        """Counts a pose."""
        position = odometry.T_odom_rig[:3, 3]
        if self._position is not None:
            self.length_m += float(np.linalg.norm(position - self._position))
        self._position, self.newest = position, odometry
        self.states[odometry.state] += 1
        self.resets = odometry.reset_counter
        self.poses += 1
