"""Contents of the messages on the bus and in recordings, decoded."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Frames = tuple[str, str]


@dataclass(frozen=True, slots=True)
class OdometryRecord:
    """Content of a nav_msgs/msg/Odometry message."""

    stamp_ns: int
    T_odom_base: Array  # (4, 4)
    covariance: Array  # (6, 6) of the pose, in odom axes
    velocity: Array  # (6,) [m/s, rad/s] in the base frame
    velocity_covariance: Array  # (6, 6)
    frames: Frames  # (parent, child)


@dataclass(frozen=True, slots=True)
class FrameTransform:
    """One edge of the frame tree: p_parent = T_parent_child @ p_child."""

    parent: str
    child: str
    T_parent_child: Array  # (4, 4)


class TwistRecord(NamedTuple):
    """Content of a TwistStamped of a ground robot."""

    stamp_ns: int
    frame: str
    velocity_mps: float
    yaw_rate_radps: float


class HeadingRecord(NamedTuple):
    """Content of a Vector3Stamped that commands a heading."""

    stamp_ns: int
    frame: str
    velocity_mps: float
    heading_rad: float


@dataclass(frozen=True, slots=True)
class DiagnosticStatus:
    """Status of one part of the robot; names and keys: omnid.transport.status_names."""

    name: str
    level: int  # OK ...
    message: str
    values: Mapping[str, str]
