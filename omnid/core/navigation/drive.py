"""A drive, and the motion that follows from it."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from calib.se2_arrays import composed, relative
from omnid.core.control.heading_controller import Setpoint, wrap_angle
from omnid.core.navigation.follower import Follower
from omnid.core.navigation.giving_way import GivingWay
from omnid.core.navigation.path import DrivePath
from omnid.core.navigation.requests import NavigationFrame
from omnid.core.navigation.situation import NOWHERE, Situation
from omnid.navigation_state import NavigationState

Array = NDArray[np.float64]

PROGRESS_M, PROGRESS_RAD = 0.05, math.radians(5)  # A smaller motion is no progress; by trial on development seeds.


@dataclass(slots=True)
class Drive:
    """A drive from its start to its end."""

    task: str  # description in words
    frame: NavigationFrame
    paths: list[DrivePath]  # paths that are driven one after the other
    follower: Follower
    resets: int
    command_ns: int = 0  # stamp of the request
    paused: str = ""  # reason of the pause; empty: it is not paused
    waits: dict[NavigationState, float] = field(default_factory=dict)  # durations [s] of the waits by their reason
    halts: int = 0  # WheelState.halts at the start, or when a person let it go on
    unlocalised_m: float = 0.0  # distance driven since the pose in the map was known
    localised_ns: int = -1  # stamp of that pose
    nearest_m: float = math.inf  # length of the path that was left at the last progress
    heading_rad: float = 0.0  # heading at the last progress
    stuck_s: float = 0.0  # time since the last progress
    last_xy: Array | None = None  # last position in odom
    giving_way: GivingWay | None = None  # None unless the base gives way now
    gave_way: int = 0  # number of times that the base gave way at the last block
    gave_way_m: float = math.inf  # length of the path that was left at that block
    around_unknown: bool = False  # floor that was not seen has stopped the base: it is an obstacle until it is passed

    def obstacles(self, now: Situation) -> Array:
        """Return what the base must not come near (N, 2), in odom."""
        known = NOWHERE if now.obstacles is None else now.obstacles
        return np.vstack([known, now.unknown]) if self.around_unknown else known

    def path_ahead(self, now: Situation, way_m: float) -> Array:
        """Return the path (N, 2) ahead, in odom."""
        T_odom_frame = relative(now.T_frame_odom(self.frame), np.zeros(3))
        ahead = self.follower.path_ahead(way_m)
        path = composed(np.repeat(T_odom_frame[None], len(ahead), 0), np.column_stack([ahead, np.zeros(len(ahead))]))
        return np.asarray(path[:, :2])

    def in_odom(self, setpoint: Setpoint, now: Situation) -> Setpoint:
        """Return a setpoint whose heading is in odom."""
        if setpoint.heading_rad is None:
            return setpoint
        turned_rad = float(now.T_frame_odom(self.frame)[2])
        return Setpoint(setpoint.velocity_mps, wrap_angle(setpoint.heading_rad - turned_rad))

    def stands_since_s(self, pose: Array, left_m: float, dt_s: float) -> float:
        """Return the time since the last progress, which is a shorter way left or a turn; dt_s: since the last call."""
        turned_rad = abs(wrap_angle(float(pose[2]) - self.heading_rad))
        if left_m < self.nearest_m - PROGRESS_M or turned_rad > PROGRESS_RAD:
            self.nearest_m, self.heading_rad, self.stuck_s = left_m, float(pose[2]), 0.0
        else:
            self.stuck_s += dt_s
        return self.stuck_s


class Navigation(NamedTuple):
    """The result of a step."""

    setpoint: Setpoint | None  # setpoint in odom; None: nothing is sent
    state: NavigationState
    reason: str
    left_m: float = math.nan  # way to the end of the path
    offset_m: float = math.nan  # distance of the base to the left of the path
