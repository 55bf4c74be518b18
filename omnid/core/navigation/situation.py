"""Inputs of the navigation at a pose, and reasons to refuse a drive that follow from them."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from calib.se2_arrays import relative
from omnid.core.control.safety_rules import COMMAND_STALE, IDLE
from omnid.core.navigation.planner import Surroundings
from omnid.core.navigation.requests import NavigationFrame
from omnid.tracking_state import MapState, TrackingState

Array = NDArray[np.float64]


class WheelState(NamedTuple):
    """State of the controller of the wheels."""

    armed: bool
    needs_request: bool  # only cmd/arm lets the wheels turn again
    disarmed_by: str = ""  # empty while armed
    reason: str = ""  # why the wheels must stop now; empty: they may turn
    source: str = ""  # source of the commands that drive; empty while none does
    held_by: str = ""  # why the collision monitor stops the base; empty: it does not
    stop_count: int = 0  # stops and faults that have made cmd/arm necessary, those that were armed again included
    stopped_by: str = ""  # reason of the newest of them

    @property
    def rule(self) -> str:
        """Rule of the controller that holds the wheels now; empty without one."""
        return "" if self.reason in (IDLE, COMMAND_STALE) else self.reason


class MapPosition(NamedTuple):
    """Pose of odom in the map."""

    T_map_odom: Array  # x, y, yaw (3,), of the base's frames
    state: MapState
    sigma_m: float  # standard deviation of the base's position in the map
    stamp_ns: int = 0  # of the pair to which it belongs


class Situation(NamedTuple):
    """The newest pose, and what else decides about motion."""

    stamp_ns: int
    pose: Array  # x, y, yaw (3,) of the base in odom
    speed_mps: float  # forwards
    yaw_rate_radps: float
    state: TrackingState
    resets: int  # how often odometry has begun again
    wheels: WheelState
    in_map: MapPosition | None = None  # None: nothing is known yet
    around: Surroundings | None = None  # what is about the base; None: nothing is known of it now

    def T_odom_frame(self, frame: NavigationFrame) -> Array:
        """Return the pose (3,) of a frame in odom."""
        if frame is NavigationFrame.ODOM or self.in_map is None:
            return np.zeros(3)
        return relative(self.in_map.T_map_odom, np.zeros(3))

    def pose_in(self, frame: NavigationFrame) -> Array:
        """Return the pose of the base in a frame (3,)."""
        return relative(self.T_odom_frame(frame), self.pose)


def refusal_to_drive(situation: Situation | None, frame: NavigationFrame, map_sigma_m: float) -> str:
    """Return why no drive can begin now, with the remedy; empty if it can."""
    if situation is None:
        return "there is no pose yet: wait until the robot is ready (`omnid listen`)"
    if not situation.wheels.armed:
        return f"not armed ({situation.wheels.disarmed_by}): arm it first (`omnid arm`)"
    if situation.state is TrackingState.LOST:
        return "odometry is lost: check the images and the light (`omnid listen`)"
    return "" if frame is NavigationFrame.ODOM else refusal_of_map(situation, map_sigma_m)


def refusal_of_map(situation: Situation, map_sigma_m: float) -> str:
    """Return why the pose in the map cannot be used, with the remedy; empty if it can."""
    in_map = situation.in_map
    if in_map is None or in_map.state is not MapState.LOCALIZED:
        return (
            "not localised in a map: no place of it has been recognised: start with one (`omnid run --map`), and drive "
            "it a little where the map was made, or use the frame odom"
        )
    if not in_map.sigma_m <= map_sigma_m:
        return (
            f"the pose in the map is uncertain by {in_map.sigma_m:.2f} m, more than {map_sigma_m:g}: drive it a little "
            "where the map was made"
        )
    return ""
