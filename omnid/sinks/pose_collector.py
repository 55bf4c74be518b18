"""Messages of a run that are kept for its result."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from omnid.messages import MapUpdate, OdometryUpdate
from omnid.tracking_state import TrackingState

Array = NDArray[np.float64]


class PoseCollector:
    """A sink that keeps every pose with its covariance and state.

    The memory grows with the run: 0.7 kB a pose, 75 MB an hour at 30 Hz.
    """

    def __init__(self) -> None:
        self._poses: list[tuple[int, Array, Array]] = []  # stamp [ns], T_odom_rig, covariance
        self._states: list[TrackingState] = []

    def process(self, odometry: OdometryUpdate) -> None:
        """Keep a pose."""
        self._poses.append((odometry.stamp_ns, odometry.T_odom_rig, odometry.covariance))
        self._states.append(TrackingState(odometry.state))

    def arrays(self) -> tuple[NDArray[np.int64], Array, Array, tuple[TrackingState, ...]]:
        """Return stamps (N,) ns, poses (N, 4, 4), covariances (N, 6, 6) in the axes of the rig, and states (N,)."""
        stamps_ns, poses, covariances = zip(*self._poses, strict=True) if self._poses else ((), (), ())
        return (
            np.array(stamps_ns, np.int64),
            np.array(poses, np.float64).reshape(-1, 4, 4),
            np.array(covariances, np.float64).reshape(-1, 6, 6),
            tuple(self._states),
        )


class Newest:
    """A sink that keeps the newest map."""

    update: MapUpdate | None = None

    def process(self, update: MapUpdate) -> None:
        """Keep a map."""
        self.update = update
