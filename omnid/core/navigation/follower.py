"""Following of a path: leg by leg, then the heading of the goal, then what is missing to it.

Along a leg the speeds are those of regulated pure pursuit (Macenski, Singh, Martin, Gines 2023, "Regulated pure pursuit
for robot path tracking"): the arc to a point ahead, more slowly in curves and before the end.
"""

from __future__ import annotations

import math
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from calib.se2_arrays import predicted
from omnid.core.control.heading_controller import Setpoint, wrap_angle
from omnid.core.navigation.path import DrivePath, drive_path
from omnid.core.navigation.settings import NavigationSettings

Array = NDArray[np.float64]

# The base turns on the spot towards a point at a larger angle, until that is small; by trial on development seeds.
TURN_RAD, TURNED_RAD = math.radians(45), math.radians(4)
BRAKE_SHARE: Final = 0.7  # Share of the deceleration that is planned, because the base follows with a lag.
LAST_MPS: Final = 0.02  # least speed before the end, and most of a base that stands, twice the noise of odometry
SETTLED: Final = 3  # poses one after the other that must be within the tolerance, standing; most corrections
STAND: Final = Setpoint(0.0, None, 0.0)  # exact zeros: no motion


class Following(NamedTuple):
    """Progress on a path, and the motion."""

    setpoint: Setpoint  # its heading is in the frame of the path
    left_m: float  # way to the end of the path; below 0 past it
    offset_m: float = 0.0  # distance to the left of the path
    done: bool = False


class Follower:
    """Drive a path to its end; poses are in the frame of the path."""

    def __init__(self, path: DrivePath, settings: NavigationSettings, speed_mps: float = 0.0) -> None:
        """speed_mps: of the base, forwards."""
        self.settings, self._settled, self._corrections = settings, 0, 0
        self._follow(path, speed_mps)
        self.aligns = path.length_m <= settings.goal_cm * 0.01  # True while the base turns at the end of the path

    def _follow(self, path: DrivePath, speed_mps: float = 0.0) -> None:
        self.path, self.s_m, self.aligns = path, 0.0, False
        self._begin(0, speed_mps)

    def _begin(self, leg: int, speed_mps: float = 0.0) -> None:
        self._leg, self._last_ns = leg, 0
        self._turns = True  # until the first step finds that no turn is needed
        first_mps = float(self.path.speed[self.path.leg(leg)][0])
        self.s_m, self._speed_mps = (
            float(self.path.s[self.path.leg(leg)][0]),
            max(0.0, math.copysign(speed_mps, speed_mps * first_mps)),
        )

    def ahead(self, way_m: float, from_m: float = 0.0) -> slice:
        """Return the points of the path for a length from the nearest one on, or from an arc length ahead of it."""
        leg, s = self.path.leg(self._leg), self.path.s
        first = min(leg.start + int(np.searchsorted(s[leg], self.s_m)), leg.stop - 1)
        first = max(first, min(int(np.searchsorted(s, from_m)), len(s) - 1))
        return slice(first, int(np.searchsorted(s, s[first] + way_m, "right")))

    def step(self, stamp_ns: int, pose: Array, speed_mps: float, yaw_rate_radps: float) -> Following:
        """Return the motion at a pose (3,) with its measured speeds."""
        # 1. Follow the legs from the pose at which the command takes effect; each ends a little before its end, the
        #    last one as near as the goal has to be reached.
        path, goal_m, is_last = self.path, self.settings.goal_cm * 0.01, self._leg == len(self.path.ends) - 1
        if not self.aligns:
            at_effect = predicted(pose, speed_mps, yaw_rate_radps, self.settings.pursuit.delay_s)
            following, of_leg_m = self._pursue(stamp_ns, at_effect, speed_mps)
            if of_leg_m > (0.25 if is_last else 1.5) * goal_m or self._turns:
                return following
            if not is_last:
                self._begin(self._leg + 1)
                return following._replace(setpoint=STAND)
            self.aligns = True
        # 2. At the end, turn to the heading of the goal on the spot.
        goal_rad, missing = path.final_heading_rad, path.goal - pose[:2]
        missing_m = float(np.hypot(*missing))
        error_rad = 0.0 if goal_rad is None else wrap_angle(goal_rad - float(pose[2]))
        is_at_rest = abs(speed_mps) < 2 * LAST_MPS and abs(yaw_rate_radps) < 5 * LAST_MPS
        within = abs(error_rad) <= math.radians(self.settings.goal_deg)
        self._settled = self._settled + 1 if is_at_rest and within else 0
        if self._settled < SETTLED:
            return Following(STAND if goal_rad is None else Setpoint(0.0, wrap_angle(goal_rad)), missing_m)
        # 3. Drive what is missing then, or end.
        if missing_m <= goal_m or self._corrections >= SETTLED:
            return Following(STAND, missing_m, done=True)
        self._corrections, self._settled = self._corrections + 1, 0
        is_behind = abs(wrap_angle(math.atan2(missing[1], missing[0]) - float(pose[2]))) > math.pi / 2
        speeds = np.full(2, -math.inf if is_behind else math.inf)
        self._follow(drive_path([pose[:2], path.goal], goal_rad, speeds=speeds, is_goal=path.is_goal))
        return Following(STAND, missing_m)

    def _pursue(self, stamp_ns: int, pose: Array, speed_mps: float) -> tuple[Following, float]:
        """Return the motion along the present leg, and what is left of that [m]."""
        s, path, leg = self.settings.pursuit, self.path, self.path.leg(self._leg)
        dt_s = min((stamp_ns - self._last_ns) * 1e-9, 0.5) if self._last_ns else 0.0
        self._last_ns = stamp_ns
        # 1. The nearest point of the path, from where the last one was.
        self.s_m = path.project(self._leg, pose, self.s_m)
        x, y, heading_rad = path.at(self._leg, self.s_m)
        of_leg_m = float(path.s[leg][-1]) - self.s_m
        offset_m = float(math.cos(heading_rad) * (pose[1] - y) - math.sin(heading_rad) * (pose[0] - x))
        following = Following(STAND, path.length_m - self.s_m, offset_m)
        # 2. The point to drive to, at a distance that grows with the speed; beyond the end the path continues straight.
        reach_m = float(np.clip(abs(speed_mps) * s.lookahead_s, *s.lookahead_m))
        to_x, to_y = path.at(self._leg, self.s_m + reach_m)[:2] - pose[:2]
        near = slice(*(leg.start + np.searchsorted(path.s[leg], (self.s_m, self.s_m + reach_m))))
        limit_mps = float(path.speed[min(near.start, leg.stop - 1)])
        half_turn_rad = math.pi if limit_mps < 0 else 0.0
        bearing_rad = math.atan2(to_y, to_x)
        aside_rad = wrap_angle(bearing_rad - pose[2] - half_turn_rad)
        # 3. Turn towards it on the spot if its angle is large.
        self._turns = abs(aside_rad) > TURN_RAD or (self._turns and abs(aside_rad) > TURNED_RAD and dt_s > 0)
        if self._turns:
            self._speed_mps = 0.0
            return following._replace(setpoint=Setpoint(0.0, wrap_angle(bearing_rad + half_turn_rad))), of_leg_m
        # 4. The arc to it (Coulter 1992): curvature 2 sin(bearing) / distance.
        curvature = 2 * math.sin(aside_rad) / max(math.hypot(to_x, to_y), 0.5 * s.lookahead_m[0])
        # 5. The speed: in curves, here and ahead (equation 5 of the paper), and so that the base still stops at the
        #    end of the leg, the last centimetres slowly.
        highest_mps = min(s.velocity_mps, abs(limit_mps))
        sharpest = float(np.abs(path.curvature[near]).max(initial=abs(curvature)))
        braking_mps = math.sqrt(2 * BRAKE_SHARE * s.acceleration_mps2 * max(of_leg_m, 0.0))
        ending_mps = max(LAST_MPS, min(braking_mps, of_leg_m / s.lookahead_s)) if of_leg_m > 0 else 0.0
        wanted_mps = max(highest_mps / max(1.0, sharpest * s.slow_radius_m), min(s.least_mps, highest_mps))
        wanted_mps = min(wanted_mps, s.yaw_rate_radps / max(abs(curvature), 1e-9), ending_mps)
        self._speed_mps = max(0.0, min(wanted_mps, self._speed_mps + s.acceleration_mps2 * dt_s))
        setpoint = Setpoint(math.copysign(self._speed_mps, limit_mps), None, self._speed_mps * curvature)
        return following._replace(setpoint=setpoint), of_leg_m
