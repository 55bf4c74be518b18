"""The poses of a run in arrays."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from omnid.messages import OdometryUpdate, PlaceUpdate
from omnid.tracking_state import MapState, TrackingState

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

    @property
    def stamps_ns(self) -> NDArray[np.int64]:
        """Stamps (N,)."""
        return np.array([stamp_ns for stamp_ns, _, _ in self._poses], np.int64)

    @property
    def T_odom_rig(self) -> Array:
        """Poses (N, 4, 4)."""
        return np.array([T for _, T, _ in self._poses], np.float64).reshape(-1, 4, 4)

    @property
    def covariances(self) -> Array:
        """Covariances (N, 6, 6) of the poses: [t; r] in the axes of the rig, m^2 and rad^2."""
        return np.array([covariance for _, _, covariance in self._poses], np.float64).reshape(-1, 6, 6)

    @property
    def states(self) -> tuple[TrackingState, ...]:
        """States (N,)."""
        return tuple(self._states)


class MapPoseCollector:
    """A sink that keeps every pose in the map: about 1 kB a pose."""

    def __init__(self) -> None:
        self.updates: list[PlaceUpdate] = []

    def process(self, update: PlaceUpdate) -> None:
        """Keep a pose."""
        self.updates.append(update)

    @property
    def stamps_ns(self) -> NDArray[np.int64]:
        """Stamps (N,)."""
        return np.array([update.stamp_ns for update in self.updates], np.int64)

    @property
    def T_map_rig(self) -> Array:
        """Poses (N, 4, 4) as they were known at that time."""
        return np.array([update.T_map_rig for update in self.updates]).reshape(-1, 4, 4)

    @property
    def known(self) -> NDArray[np.bool_]:
        """At which poses (N,) it was known at that time where odom lay in the map."""
        return np.array([update.is_known for update in self.updates], np.bool_)

    @property
    def states(self) -> tuple[MapState, ...]:
        """States (N,)."""
        return tuple(update.state for update in self.updates)
