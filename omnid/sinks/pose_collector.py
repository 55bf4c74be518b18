"""The poses of a run in arrays."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from omnid.messages import OdometryUpdate, PlaceUpdate
from omnid.tracking_state import MapState, TrackingState

FIRST_CAPACITY = 1024  # poses; doubled whenever it is reached


class PoseCollector:
    """A sink that keeps every pose with its covariance and state.

    The memory grows with the run: 432 bytes a pose, 47 MB an hour at 30 Hz, and up to twice that, because the arrays
    are doubled when they are full.
    """

    def __init__(self) -> None:
        self._count = 0
        self._stamps_ns = np.zeros(FIRST_CAPACITY, np.int64)
        self._T_odom_rig = np.zeros((FIRST_CAPACITY, 4, 4))
        self._covariances = np.zeros((FIRST_CAPACITY, 6, 6))
        self._states: list[TrackingState] = []

    def process(self, odometry: OdometryUpdate) -> None:
        """Keep a pose."""
        # 1. Double arrays that are full.
        if self._count == len(self._stamps_ns):
            self._stamps_ns, self._T_odom_rig, self._covariances = (
                np.concatenate([full, np.zeros_like(full)])
                for full in (self._stamps_ns, self._T_odom_rig, self._covariances)
            )
        # 2. Write the pose.
        self._stamps_ns[self._count] = odometry.stamp_ns
        self._T_odom_rig[self._count] = odometry.T_odom_rig
        self._covariances[self._count] = odometry.covariance
        self._states.append(TrackingState(odometry.state))
        self._count += 1

    @property
    def stamps_ns(self) -> NDArray[np.int64]:
        """Stamps (N,)."""
        return self._stamps_ns[: self._count]

    @property
    def T_odom_rig(self) -> NDArray[np.float64]:
        """Poses (N, 4, 4)."""
        return self._T_odom_rig[: self._count]

    @property
    def covariances(self) -> NDArray[np.float64]:
        """Covariances (N, 6, 6) of the poses: [t; r] in the axes of the rig, m^2 and rad^2."""
        return self._covariances[: self._count]

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
    def T_map_rig(self) -> NDArray[np.float64]:
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
