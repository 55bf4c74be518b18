"""Following of a whole path: leg by leg, then the heading of the goal, then what is missing to it.

The speeds along a leg follow from regulated pure pursuit, which stands first.
"""

from __future__ import annotations

import math
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from calib.se2_arrays import predicted
from omnid.core.control.heading_controller import Setpoint, wrap_angle
from omnid.core.navigation.path import DrivePath, PathLeg, straight_leg
from omnid.core.navigation.settings import NavigationSettings, PursuitSettings

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

    def __init__(self, leg: PathLeg, settings: PursuitSettings, s_m: float = 0.0, speed_mps: float = 0.0) -> None:
        """s_m: way on the leg to begin at. speed_mps: of the base, in the direction of the leg."""
        self.leg = leg
        self.s_m = s_m
        self._settings = settings
        self._turning = True  # True until the first step finds that no turn is needed
        self._speed_mps = speed_mps
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


# Set by trial on development seeds, where a line gives no other reason.
SETTLED: Final = 3  # poses one after the other that must be within the tolerance, standing
SETTLED_RADPS: Final = 0.1
SETTLED_MPS: Final = 0.03
CORNER_M: Final = 0.03  # A leg ends this far from its end, unless it is the last one.
CORRECTIONS: Final = 3  # Most short drives that correct the distance left to the goal.
BEHIND_RAD: Final = math.pi / 2  # A goal in a direction beyond this is behind: the base drives backwards to it.
STAND: Final = Setpoint(0.0, None, 0.0)  # exact zeros: no motion


class Following(NamedTuple):
    """Progress on a path, and the motion."""

    setpoint: Setpoint  # its heading is in the frame of the path
    left_m: float  # way to the end of the path
    offset_m: float  # distance to the left of the path
    turning: bool
    done: bool = False
    missed_m: float = 0.0  # distance to the goal, where done


class PathAhead(NamedTuple):
    """Points of a path, in its frame."""

    xy: Array  # (N, 2)
    legs: NDArray[np.intp]  # (N,) numbers of their legs
    s: Array  # (N,) way on the leg


class Follower:
    """Drive a path to its end; poses are in the frame of the path."""

    def __init__(
        self, path: DrivePath, settings: NavigationSettings, leg: int = 0, s_m: float = 0.0, speed_mps: float = 0.0
    ) -> None:
        """leg, s_m: where on the path to begin. speed_mps: of the base, ahead."""
        self.path = path
        self.settings = settings
        self._legs = list(path.legs)
        self._number = min(leg, len(self._legs) - 1)
        at_goal = path.length_m <= settings.goal_cm * 0.01 or leg >= len(self._legs)
        along_mps = max(0.0, -speed_mps if self._legs[self._number].backwards else speed_mps)
        self._pursuit = None if at_goal else Pursuit(self._legs[leg], settings.pursuit, s_m, along_mps)
        self._settled = 0
        self._corrections = 0

    @property
    def aligns(self) -> bool:
        """True while the base turns at the end of the path."""
        return self._pursuit is None

    def ahead(self, way_m: float) -> PathAhead:
        """Return the path from the nearest point on, of at least a length, through the next legs if need be."""
        if self._pursuit is None:
            return PathAhead(
                self.path.goal[None], np.array([self._number]), np.array([self._legs[self._number].length_m])
            )
        pieces: list[tuple[Array, NDArray[np.intp], Array]] = []
        s_m, left_m = self._pursuit.s_m, way_m
        for number in range(self._number, len(self._legs)):
            leg = self._legs[number]
            within = (leg.s > s_m) & (leg.s <= s_m + left_m)
            s = np.append(s_m, leg.s[within])
            pieces.append((np.vstack([leg.at(s_m)[None, :2], leg.xy[within]]), np.full(len(s), number), s))
            left_m, s_m = left_m - (leg.length_m - s_m), 0.0
            if left_m <= 0:
                break
        return PathAhead(*(np.concatenate(parts) for parts in zip(*pieces, strict=True)))

    @property
    def place(self) -> tuple[int, float]:
        """The leg and the way on it."""
        return self._number, self._legs[self._number].length_m if self._pursuit is None else self._pursuit.s_m

    @property
    def leg_left_m(self) -> float:
        """Way to the end of the leg."""
        return 0.0 if self._pursuit is None else self._pursuit.leg.length_m - self._pursuit.s_m

    def step(
        self, stamp_ns: int, pose: Array, speed_mps: float, yaw_rate_radps: float, obstacle_m: float = math.inf
    ) -> Following:
        """Return the motion at a pose (3,) with its measured speeds."""
        # 1. Predict the pose at which the command takes effect.
        at_effect = predicted(pose, speed_mps, yaw_rate_radps, self.settings.pursuit.delay_s)
        # 2. Follow the legs.
        if self._pursuit is not None:
            following = self._follow(self._pursuit, stamp_ns, at_effect, speed_mps, obstacle_m)
            if following is not None:
                return following
        # 3. At the end, turn to the heading of the goal, and drive what is missing.
        return self._align(pose, speed_mps, yaw_rate_radps)

    def _follow(
        self, pursuit: Pursuit, stamp_ns: int, pose: Array, speed_mps: float, obstacle_m: float
    ) -> Following | None:
        """Follow the leg; None at the end of the last one."""
        approach = pursuit.step(stamp_ns, pose, speed_mps, obstacle_m=obstacle_m)
        is_last = self._number == len(self._legs) - 1
        end_m = 0.25 * self.settings.goal_cm * 0.01 if is_last else CORNER_M
        if approach.left_m > end_m or approach.turning:
            left_m = approach.left_m + sum(leg.length_m for leg in self._legs[self._number + 1 :])
            return Following(approach.setpoint, left_m, approach.offset_m, approach.turning)
        if is_last:
            self._pursuit = None
            return None
        self._number += 1
        self._pursuit = Pursuit(self._legs[self._number], self.settings.pursuit)
        left_m = sum(leg.length_m for leg in self._legs[self._number :])
        return Following(STAND, left_m, approach.offset_m, True)

    def _align(self, pose: Array, speed_mps: float, yaw_rate_radps: float) -> Following:
        """Turn to the heading of the goal on the spot; then drive the distance that is missing, or end."""
        goal_rad, missing = self.path.final_heading_rad, self.path.goal - pose[:2]
        missing_m = float(np.hypot(*missing))
        error_rad = 0.0 if goal_rad is None else wrap_angle(goal_rad - float(pose[2]))
        is_at_rest = abs(speed_mps) < SETTLED_MPS and abs(yaw_rate_radps) < SETTLED_RADPS
        within = abs(error_rad) <= math.radians(self.settings.goal_deg)
        self._settled = self._settled + 1 if is_at_rest and within else 0
        setpoint = STAND if goal_rad is None else Setpoint(0.0, goal_rad)
        if self._settled < SETTLED:
            return Following(setpoint, missing_m, 0.0, True)
        if missing_m <= self.settings.goal_cm * 0.01 or self._corrections >= CORRECTIONS:
            return Following(STAND, 0.0, 0.0, False, True, missing_m)
        self._corrections += 1
        self._settled = 0
        aside_rad = abs(wrap_angle(math.atan2(missing[1], missing[0]) - float(pose[2])))
        self._legs.append(straight_leg(pose, self.path.goal, backwards=aside_rad > BEHIND_RAD))
        self._number += 1
        self._pursuit = Pursuit(self._legs[-1], self.settings.pursuit)
        return Following(STAND, missing_m, 0.0, True)
