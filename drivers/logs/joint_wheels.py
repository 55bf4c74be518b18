"""Wheels of a base in sensor_msgs/msg/JointState: velocities of the joints of a left and a right wheel."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import NamedTuple

from drivers.errors import FrameDecodeError

JOINT_STATE = "sensor_msgs/msg/JointState"


class JointWheels(NamedTuple):
    """The joints of the driven wheels, and the geometry of the base."""

    left: str
    right: str
    radius_m: float
    track_m: float

    def rates(self, velocities_radps: Mapping[str, float]) -> tuple[float, float] | None:
        """Return forward velocity [m/s] and yaw rate [rad/s] from velocities by joint; None where neither is named.

        Raise FrameDecodeError where one is missing or not finite.
        """
        found = [velocities_radps.get(name) for name in (self.left, self.right)]
        if found == [None, None]:
            return None  # other joints have messages of their own
        left, right = (math.nan if value is None else value * self.radius_m for value in found)
        if not (math.isfinite(left) and math.isfinite(right)):
            raise FrameDecodeError(f"a {JOINT_STATE} has no velocity of {self.left} or of {self.right}")
        return (left + right) / 2, (right - left) / self.track_m
