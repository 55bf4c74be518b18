"""Regulated pure pursuit: the motion that follows a leg of a path.

Coulter 1992 (pure pursuit); Macenski, Singh, Martin, Gines, "Regulated pure pursuit for robot path tracking",
Autonomous Robots 2023: the speed falls in curves, near obstacles and before the end.
"""

from __future__ import annotations

import math
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from omnid.core.control.heading_controller import Setpoint, wrap_angle
from omnid.core.navigation.path import PathLeg
from omnid.core.navigation.settings import PursuitSettings

Array = NDArray[np.float64]

# The base turns on the spot towards a point at a larger angle; by trial on development seeds.
TURN_RAD: Final = math.radians(45)
TURNED_RAD: Final = math.radians(4)  # The turn ends below this angle; by trial on development seeds.
BRAKE_SHARE: Final = 0.7  # Share of the deceleration that is planned, because the base follows with a lag.
APPROACH_HZ: Final = 1.2  # speed per distance to the end, so that the last centimetres are slow
LAST_MPS: Final = 0.02  # least speed before the end; by trial on development seeds


class Approach(NamedTuple):
    """A position on a leg and the motion there."""

    setpoint: Setpoint  # its heading is in the frame of the path
    s_m: float  # way on the leg
    left_m: float  # way to the end of the leg; below 0 past it
    offset_m: float  # distance to the left of the path
    turning: bool  # standing, towards the path


class Pursuit:
    """Follow one leg; pose and path are in one frame."""

    def __init__(self, leg: PathLeg, settings: PursuitSettings, s_m: float = 0.0) -> None:
        """s_m: way on the leg to begin at."""
        self.leg = leg
        self.s_m = s_m
        self._settings = settings
        self._turning = True  # True until the first step finds that no turn is needed
        self._speed_mps = 0.0
        self._last_ns: int | None = None

    def step(
        self, stamp_ns: int, pose: Array, speed_mps: float, *, obstacle_m: float = math.inf, stops_at_end: bool = True
    ) -> Approach:
        """Return the motion at a pose x, y, yaw (3,).

        speed_mps: measured, forwards. obstacle_m: from the outline of the base to the nearest obstacle.
        """
        s = self._settings
        dt_s = 0.0 if self._last_ns is None else min(max((stamp_ns - self._last_ns) * 1e-9, 0.0), 0.5)
        self._last_ns = stamp_ns
        # 1. The nearest point of the path, from where the last one was.
        self.s_m = self.leg.project(pose, self.s_m)
        left_m, offset_m = self.leg.length_m - self.s_m, self.leg.offset_m(pose, self.s_m)
        # 2. The point to drive to, at a distance that grows with the speed; beyond the end the path continues straight.
        low_m, high_m = s.lookahead_m
        reach_m = min(max(low_m, abs(speed_mps) * s.lookahead_s), high_m)
        target = self.leg.at(self.s_m + reach_m)
        course_rad = pose[2] + (math.pi if self.leg.backwards else 0.0)
        bearing_rad = math.atan2(target[1] - pose[1], target[0] - pose[0])
        aside_rad = wrap_angle(bearing_rad - course_rad)
        # 3. Turn towards it on the spot if its angle is large.
        if abs(aside_rad) > TURN_RAD or (self._turning and abs(aside_rad) > TURNED_RAD and dt_s > 0):
            self._turning, self._speed_mps = True, 0.0
            heading_rad = wrap_angle(bearing_rad + (math.pi if self.leg.backwards else 0.0))
            return Approach(Setpoint(0.0, heading_rad), self.s_m, left_m, offset_m, True)
        self._turning = False
        # 4. The arc to it (Coulter 1992): curvature 2 sin(bearing) / distance.
        curvature = 2 * math.sin(aside_rad) / max(math.hypot(target[0] - pose[0], target[1] - pose[1]), 0.5 * low_m)
        # 5. The speed, regulated.
        wanted_mps = self._regulated(curvature, reach_m, obstacle_m)
        if stops_at_end:
            wanted_mps = min(wanted_mps, self._ending(left_m))
        self._speed_mps = max(0.0, min(wanted_mps, self._speed_mps + s.acceleration_mps2 * dt_s))
        yaw_rate = self._speed_mps * curvature
        sign = -1.0 if self.leg.backwards else 1.0
        return Approach(Setpoint(sign * self._speed_mps, None, yaw_rate), self.s_m, left_m, offset_m, False)

    def _regulated(self, curvature: float, reach_m: float, obstacle_m: float) -> float:
        """Return the speed in curves, here and ahead, and near obstacles (equations 5 to 7 of the paper)."""
        s = self._settings
        highest_mps = min(s.velocity_mps, self.leg.speed_at(self.s_m))
        wanted_mps = highest_mps
        sharpest = max(abs(curvature), self.leg.sharpest(self.s_m, reach_m))
        if sharpest * s.slow_radius_m > 1.0:
            wanted_mps = highest_mps / (sharpest * s.slow_radius_m)
        if obstacle_m < s.slow_obstacle_m:
            wanted_mps = min(wanted_mps, highest_mps * max(0.0, obstacle_m) / s.slow_obstacle_m)
        wanted_mps = max(wanted_mps, min(s.least_mps, highest_mps))
        return min(wanted_mps, s.yaw_rate_radps / max(abs(curvature), 1e-9))

    def _ending(self, left_m: float) -> float:
        """Return the speed from which the base still stops at the end."""
        if left_m <= 0:
            return 0.0
        braking_mps = math.sqrt(2 * BRAKE_SHARE * self._settings.acceleration_mps2 * left_m)
        return max(LAST_MPS, min(braking_mps, APPROACH_HZ * left_m))
