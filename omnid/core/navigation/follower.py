"""Following of a path: leg by leg, then the heading of the goal, then what is missing to it.

Along a leg the speeds are those of regulated pure pursuit (Macenski, Singh, Martin, Gines 2023, "Regulated pure pursuit
for robot path tracking"): the arc to a point ahead, more slowly in curves, near obstacles and before the end.
"""

from __future__ import annotations

import math
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from calib.se2_arrays import predicted
from omnid.core.control.collision_monitor import LEAST_MPS
from omnid.core.control.heading_controller import Setpoint, wrap_angle
from omnid.core.navigation.path import BEGIN, DrivePath, PathPlace, straight_leg
from omnid.core.navigation.settings import NavigationSettings

Array = NDArray[np.float64]

# The base turns on the spot towards a point at a larger angle, until that is small; by trial on development seeds.
TURN_RAD, TURNED_RAD = math.radians(45), math.radians(4)
BRAKE_SHARE: Final = 0.7  # Share of the deceleration that is planned, because the base follows with a lag.
APPROACH_HZ: Final = 1.2  # speed per distance to the end, so that the last centimetres are slow
SETTLED: Final = 3  # consecutive poses at rest that must be within the tolerance
SETTLED_RADPS: Final = 0.1
CORNER_M: Final = 0.03  # A leg ends this far from its end, unless it is the last one.
CORRECTIONS: Final = 3  # Most short drives that correct the distance left to the goal.
STANDSTILL: Final = Setpoint(0.0, None, 0.0)  # exact zeros: no motion


class Following(NamedTuple):
    """Progress on a path, and the motion."""

    setpoint: Setpoint  # its heading is in the frame of the path
    left_m: float  # way to the end of the path; below 0 past it
    offset_m: float = 0.0  # distance to the left of the path
    missed_m: float | None = None  # distance to the goal at the end of the drive; None before


class Follower:
    """Drive a path to its end; poses are in the frame of the path."""

    def __init__(
        self, path: DrivePath, settings: NavigationSettings, place: PathPlace = BEGIN, speed_mps: float = 0.0
    ) -> None:
        """place: where on the path to begin. speed_mps: of the base, forwards."""
        self.path, self.settings, self._legs = path, settings, list(path.legs)
        # True while the base turns at the end of the path.
        self.aligns = path.length_m <= settings.goal_cm * 0.01 or place.leg >= len(path.legs)
        self._begin(min(place.leg, len(path.legs) - 1), place.s_m, speed_mps)
        self._settled = self._corrections = 0

    def _begin(self, number: int, s_m: float = 0.0, speed_mps: float = 0.0) -> None:
        """Begin a leg at a way on it."""
        self._number, self._leg, self._s_m = number, self._legs[number], s_m
        self._last_ns: int | None = None
        self._turns = True  # until the first step finds that no turn is needed
        self._speed_mps = max(0.0, -speed_mps if self._leg.backwards else speed_mps)

    def ahead(self, way_m: float) -> tuple[Array, list[PathPlace]]:
        """Return points (N, 2) of the path from the nearest one on, of at least a length, and their places on it."""
        if self.aligns:
            return self.path.goal[None], [PathPlace(self._number, self._leg.length_m)]
        pieces: list[Array] = []
        places: list[PathPlace] = []
        s_m, left_m = self._s_m, way_m
        for number in range(self._number, len(self._legs)):
            leg = self._legs[number]
            within = (leg.s > s_m) & (leg.s <= s_m + left_m)
            pieces += [leg.at(s_m)[None, :2], leg.xy[within]]
            places += [PathPlace(number, s) for s in (s_m, *leg.s[within].tolist())]
            left_m, s_m = left_m - (leg.length_m - s_m), 0.0
            if left_m <= 0:
                break
        return np.vstack(pieces), places

    def step(
        self, stamp_ns: int, pose: Array, speed_mps: float, yaw_rate_radps: float, obstacle_m: float = math.inf
    ) -> Following:
        """Return the motion at a pose (3,) with its measured speeds.

        obstacle_m: from the outline of the base to the nearest obstacle next to the path.
        """
        # 1. Follow the legs from the pose at which the command takes effect; each ends a little before its end, the
        #    last one as near as the goal has to be reached.
        goal_m, rest = self.settings.goal_cm * 0.01, self._legs[self._number + 1 :]
        if not self.aligns:
            at_effect = predicted(pose, speed_mps, yaw_rate_radps, self.settings.pursuit.delay_s)
            following = self._pursue(stamp_ns, at_effect, speed_mps, obstacle_m)
            left_m = sum(leg.length_m for leg in rest)
            if following.left_m > (CORNER_M if rest else 0.25 * goal_m) or self._turns:
                return following._replace(left_m=following.left_m + left_m)
            if rest:
                self._begin(self._number + 1)
                return Following(STANDSTILL, left_m, following.offset_m)
            self.aligns = True
        # 2. At the end, turn to the heading of the goal on the spot.
        goal_rad, missing = self.path.final_heading_rad, self.path.goal - pose[:2]
        missing_m = float(np.hypot(*missing))
        error_rad = 0.0 if goal_rad is None else wrap_angle(goal_rad - float(pose[2]))
        is_at_rest = abs(speed_mps) < 2 * LEAST_MPS and abs(yaw_rate_radps) < SETTLED_RADPS
        within = abs(error_rad) <= math.radians(self.settings.goal_deg)
        self._settled = self._settled + 1 if is_at_rest and within else 0
        if self._settled < SETTLED:
            return Following(STANDSTILL if goal_rad is None else Setpoint(0.0, goal_rad), missing_m)
        # 3. Drive what is missing then, or end.
        if missing_m <= goal_m or self._corrections >= CORRECTIONS:
            return Following(STANDSTILL, 0.0, 0.0, missing_m)
        self._corrections, self._settled, self.aligns = self._corrections + 1, 0, False
        aside_rad = abs(wrap_angle(math.atan2(missing[1], missing[0]) - float(pose[2])))
        self._legs.append(straight_leg(pose, self.path.goal, backwards=aside_rad > math.pi / 2))
        self._begin(self._number + 1)
        return Following(STANDSTILL, missing_m)

    def _pursue(self, stamp_ns: int, pose: Array, speed_mps: float, obstacle_m: float) -> Following:
        """Return the motion along the present leg, and the way that is left of it."""
        s, leg = self.settings.pursuit, self._leg
        dt_s = 0.0 if self._last_ns is None else min(max((stamp_ns - self._last_ns) * 1e-9, 0.0), 0.5)
        self._last_ns = stamp_ns
        # 1. The nearest point of the path, from where the last one was.
        self._s_m = leg.project(pose, self._s_m)
        x, y, heading_rad = leg.at(self._s_m)
        left_m = leg.length_m - self._s_m
        offset_m = float(math.cos(heading_rad) * (pose[1] - y) - math.sin(heading_rad) * (pose[0] - x))
        # 2. The point to drive to, at a distance that grows with the speed; beyond the end the path continues straight.
        reach_m = float(np.clip(abs(speed_mps) * s.lookahead_s, *s.lookahead_m))
        to_x, to_y = leg.at(self._s_m + reach_m)[:2] - pose[:2]
        half_turn_rad = math.pi if leg.backwards else 0.0
        bearing_rad = math.atan2(to_y, to_x)
        aside_rad = wrap_angle(bearing_rad - pose[2] - half_turn_rad)
        # 3. Turn towards it on the spot if its angle is large.
        self._turns = abs(aside_rad) > TURN_RAD or (self._turns and abs(aside_rad) > TURNED_RAD and dt_s > 0)
        if self._turns:
            self._speed_mps = 0.0
            return Following(Setpoint(0.0, wrap_angle(bearing_rad + half_turn_rad)), left_m, offset_m)
        # 4. The arc to it (Coulter 1992): curvature 2 sin(bearing) / distance.
        curvature = 2 * math.sin(aside_rad) / max(math.hypot(to_x, to_y), 0.5 * s.lookahead_m[0])
        # 5. The speed: in curves, here and ahead, and near obstacles (equations 5 to 7 of the paper), and so that the
        #    base still stops at the end.
        near = slice(*np.searchsorted(leg.s, (self._s_m, self._s_m + reach_m)))
        highest_mps = min(s.velocity_mps, float(leg.speed[min(near.start, len(leg.s) - 1)]))
        sharpest = float(np.abs(leg.curvature[near]).max(initial=abs(curvature)))
        share = min(1.0, 1.0 / max(sharpest * s.slow_radius_m, 1e-9), max(0.0, obstacle_m) / s.slow_obstacle_m)
        braking_mps = math.sqrt(2 * BRAKE_SHARE * s.acceleration_mps2 * max(left_m, 0.0))
        ending_mps = max(LEAST_MPS, min(braking_mps, APPROACH_HZ * left_m)) if left_m > 0 else 0.0
        wanted_mps = max(share * highest_mps, min(s.least_mps, highest_mps))
        wanted_mps = min(wanted_mps, s.yaw_rate_radps / max(abs(curvature), 1e-9), ending_mps)
        self._speed_mps = max(0.0, min(wanted_mps, self._speed_mps + s.acceleration_mps2 * dt_s))
        sign = -1.0 if leg.backwards else 1.0
        return Following(Setpoint(sign * self._speed_mps, None, self._speed_mps * curvature), left_m, offset_m)
