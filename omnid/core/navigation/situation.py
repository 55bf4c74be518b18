"""Inputs of the navigation at a pose, and reasons to refuse or to wait that follow from them."""

from __future__ import annotations

from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from calib.se2_arrays import composed
from omnid.core.control.control_law import ControllerState
from omnid.core.navigation.requests import NavigationFrame
from omnid.core.navigation.surroundings import Surroundings
from omnid.errors import OmnidError
from omnid.tracking_state import MapState, TrackingState

Array = NDArray[np.float64]

# A larger sigma means that the pose in the map is unknown: it is a kilometre then.
UNKNOWN_M: Final = 100.0


class MapPosition(NamedTuple):
    """Pose of odom in the map."""

    T_map_odom: Array  # x, y, yaw (3,), of the base's frames
    state: MapState
    sigma_m: float  # standard deviation of the base's position in the map
    stamp_ns: int = 0  # of the pair to which it belongs


class Situation(NamedTuple):
    """The newest pose, and the other inputs that decide about motion."""

    stamp_ns: int
    pose: Array  # x, y, yaw (3,) of the base in odom
    speed_mps: float  # forwards
    yaw_rate_radps: float
    state: TrackingState
    resets: int  # how often odometry has begun again
    wheels: ControllerState
    in_map: MapPosition | None = None  # None: nothing is known yet
    around: Surroundings | None = None  # surroundings of the base; None: unknown

    def T_frame_odom(self, frame: NavigationFrame) -> Array:
        """Return the pose of odom in a frame (3,)."""
        if frame is NavigationFrame.MAP and self.in_map is not None:
            return self.in_map.T_map_odom
        return np.zeros(3)

    def pose_in(self, frame: NavigationFrame) -> Array:
        """Return the pose of the base in a frame (3,)."""
        return np.asarray(composed(self.T_frame_odom(frame)[None], self.pose)[0])


def require_drivable(situation: Situation, frame: NavigationFrame, map_sigma_m: float) -> None:
    """Raise OmnidError with the remedy where nothing can be driven now in a frame."""
    wheels, refusal = situation.wheels, ""
    if not wheels.armed:
        refusal = f"not armed ({wheels.disarmed_by}): arm it first (`omnid arm`)"
    elif situation.state is TrackingState.LOST:
        refusal = "odometry is lost: check the images and the light (`omnid listen`)"
    elif frame is NavigationFrame.MAP:
        refusal = refusal_of_map(situation, map_sigma_m)
    if refusal:
        raise OmnidError(refusal)


def refusal_of_map(situation: Situation, map_sigma_m: float) -> str:
    """Return why the pose in the map cannot be used, with the remedy; empty if it can."""
    in_map = situation.in_map
    if in_map is None or in_map.state is MapState.LOST:
        return (
            "not localised in a map: start it with one (`omnid run --map`) and drive it a little where the map "
            "was made, or use the frame odom"
        )
    if in_map.state is MapState.ODOMETRY_ONLY:
        return (
            "not localised in a map: no place of it has been recognised yet: drive it a little where the map was "
            "made (in a new map: back to where it has been), or use the frame odom"
        )
    if not in_map.sigma_m <= map_sigma_m:
        return (
            f"the pose in the map is uncertain by {in_map.sigma_m:.2f} m, more than "
            f"{map_sigma_m:g}: drive it a little where the map was made"
        )
    return ""
