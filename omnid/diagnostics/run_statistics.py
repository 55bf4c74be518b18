"""Statistics of a run: poses, path length, states, resets; and the counters that a finished run reports."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from omnid.core.stereo.tiles import Side
from omnid.messages import OdometryUpdate
from omnid.tracking_state import TrackingState


class RunStatistics:
    """A sink that counts poses; other threads may read its attributes meanwhile."""

    def __init__(self) -> None:
        self.poses = 0
        self.length_m = 0.0
        self.states: Counter[str] = Counter()
        self.resets = 0
        self.dark = 0  # pairs that were too dark
        self.lost_parts: Counter[Side] = Counter()  # pairs in which a part of a camera's image was frozen or blind
        self.too_fast = 0  # pairs whose pose was refused for its speed alone
        self.fastest_mps = 0.0  # of those
        self.newest: OdometryUpdate | None = None
        self._position: NDArray[np.float64] | None = None

    def process(self, odometry: OdometryUpdate) -> None:
        """Count a pose."""
        # 1. The way.
        position = odometry.T_odom_rig[:3, 3]
        if self._position is not None:
            self.length_m += float(np.linalg.norm(position - self._position))
        self._position, self.newest = position, odometry
        # 2. States of poses and images.
        self.states[odometry.state] += 1
        self.dark += odometry.light.is_too_dark
        columns = odometry.depth.panoramas.tiles.columns
        self.lost_parts.update(side for side, found in columns.items() if found.any())
        self.resets = odometry.reset_counter
        self.too_fast += odometry.refused_mps > 0
        self.fastest_mps = max(self.fastest_mps, odometry.refused_mps)
        self.poses += 1


@dataclass(frozen=True, slots=True)
class RunCounters:
    """Counts of a run over a log."""

    pairs: int  # of images
    poses: int
    length_m: float  # of the path
    states: Mapping[TrackingState, int]  # poses in each state
    resets: int  # gaps in the trajectory after which tracking began again
    drops: Mapping[str, int]  # messages lost, by reason; zeros too
    map: Mapping[str, int] = field(default_factory=dict)  # voxels and points; empty without a map
    places: Mapping[str, int] = field(default_factory=dict)  # keyframes, loops, refusals; empty without a map of places
    motor: Mapping[str, int] = field(default_factory=dict)  # commands, errors, stops; empty without a motor

    @property
    def no_pose(self) -> bool:
        """True if no pose was measured: there are none, or all are predictions."""
        return self.poses == self.states[TrackingState.LOST]

    @classmethod
    def of(cls, statistics: RunStatistics, pairs: int, drops: Mapping[str, int]) -> RunCounters:
        """Return the counters of a run from its statistics."""
        states = {state: statistics.states[state] for state in TrackingState}
        return cls(pairs, statistics.poses, statistics.length_m, states, statistics.resets, drops)
