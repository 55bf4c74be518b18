"""Input of the localisation in a map, from the odometry, and its result."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from omnid.core.odometry.stereo_frame import StereoFrame
from omnid.tracking_state import MapState

Array = NDArray[np.float64]


@dataclass(frozen=True, slots=True, eq=False)
class OdometryFrame:
    """A frame with its pose by odometry."""

    stereo: StereoFrame
    stamp_ns: int
    T_odom_rect: Array  # (4, 4)
    covariance: Array  # (6, 6) of it, [t; r] in the rectified frame
    lost: bool
    resets: int  # gaps of unknown motion so far
    is_keyframe: bool  # its dense depth is known
    scan: Callable[[], NDArray[np.float32]]  # returns the nearest obstacles by azimuth, see mapping/range_scan.py


@dataclass(frozen=True, slots=True, eq=False)
class MapPose:
    """Pose of odom in the map, and of the frame."""

    T_map_odom: Array  # (4, 4) of the rectified frame of the first pair
    covariance: Array  # (6, 6) of T_map_rect, [t; r] in the rectified frame
    state: MapState
    keyframe: int  # id of the newest keyframe of the run; NO_KEYFRAME: none since the last gap
    T_keyframe_rect: Array  # (4, 4) of the frame in it, by odometry
