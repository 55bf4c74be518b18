"""Input of the localisation in a map, which is a frame of the odometry, and its result."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from omnid.core.odometry.stereo_frame import StereoFrame
from omnid.tracking_state import MapState

Array = NDArray[np.float64]

# Covariance in a map of which nothing has been recognised, m^2 and rad^2, because it may be a kilometre away in any
# direction.
UNKNOWN_PLACE: Final[Array] = np.diag([1e6] * 3 + [np.pi**2] * 3)


@dataclass(frozen=True, slots=True, eq=False)
class OdometryFrame:
    """A frame with its pose by odometry."""

    stereo: StereoFrame
    stamp_ns: int
    T_odom_rect: Array  # (4, 4)
    covariance: Array  # (6, 6) of T_odom_rect, [t; r] in the rectified frame: m^2, m rad, rad^2
    lost: bool
    resets: int  # gaps of unknown motion so far
    is_keyframe: bool  # True if its dense depth is known
    scan: Callable[[], NDArray[np.float32]]  # returns distances (SECTORS,) [m], see mapping/range_scan.py
    free_m: Callable[[], NDArray[np.float32]]  # returns up to where floor was seen, asked once at a keyframe


@dataclass(frozen=True, slots=True, eq=False)
class MapPose:
    """Pose of odom in the map, and pose of the frame in the newest keyframe."""

    T_map_odom: Array  # (4, 4); odom is the rectified frame of the first pair
    covariance: Array  # (6, 6) of T_map_rect, the pose of the frame in the map; [t; r] in the rectified frame
    state: MapState
    keyframe: int  # id of the newest keyframe of the run; NO_KEYFRAME: none since the last gap
    T_keyframe_rect: Array  # (4, 4) pose of the frame in that keyframe by odometry; the identity where there is none

    @property
    def is_known(self) -> bool:
        """True if it is known where odom lies in the map."""
        return self.covariance is not UNKNOWN_PLACE
