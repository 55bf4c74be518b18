"""Following of a whole path: leg by leg, then the heading of the goal, then what is missing to it."""

from __future__ import annotations

import math
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from calib.se2_arrays import predicted
from omnid.core.control.heading_controller import Setpoint, wrap_angle
from omnid.core.navigation.path import DrivePath, straight_leg
from omnid.core.navigation.pursuit import Pursuit
from omnid.core.navigation.settings import NavigationSettings

Array = NDArray[np.float64]

# Set by trial on development seeds, where a line gives no other reason.
SETTLED: Final = 3  # poses one after the other that must be within the tolerance, standing
SETTLED_RADPS: Final = 0.1
SETTLED_MPS: Final = 0.03
CORNER_M: Final = 0.03  # A leg ends this far from its end, unless it is the last one.
CORRECTIONS: Final = 3  # Most short drives that correct the distance left to the goal.
BEHIND_RAD: Final = math.pi / 2  # A goal in a direction beyond this is behind: the base drives backwards to it.
SKIP_M: Final = 2.0  # Length before and after a corner within which a detour may cut it.
SKIP_BESIDE_M: Final = 0.15
STAND: Final = Setpoint(0.0, None, 0.0)  # exact zeros: no motion


class Following(NamedTuple):
    """Progress on a path, and the motion."""

    setpoint: Setpoint  # its heading is in the frame of the path
    left_m: float  # way to the end of the path
    offset_m: float  # distance to the left of the path
    turning: bool
    done: bool = False
    missed_m: float = 0.0  # distance to the goal, where done


class Follower:
    """Drive a path to its end; poses are in the frame of the path."""

    def __init__(self, path: DrivePath, settings: NavigationSettings, leg: int = 0, s_m: float = 0.0) -> None:
        """leg, s_m: where on the path to begin."""
        self.path = path
        self._settings = settings
        self._legs = list(path.legs)
        self._number = leg
        at_goal = path.length_m <= settings.goal_cm * 0.01
        self._pursuit = None if at_goal else Pursuit(self._legs[leg], settings.pursuit, s_m)
        self._settled = 0
        self._corrections = 0

    @property
    def pursuit(self) -> Pursuit | None:
        """The leg that is followed; None while the base turns at the end."""
        return self._pursuit

    def path_ahead(self, way_m: float) -> Array:
        """Return the path (N, 2) from the nearest point on, of at least a length, through the next legs if need be."""
        if self._pursuit is None:
            return self.path.goal[None]
        leg = self._pursuit.leg
        s_m = self._pursuit.s_m
        pieces = [leg.at(s_m)[None, :2], leg.xy[(leg.s > s_m) & (leg.s <= s_m + way_m)]]
        left_m = leg.length_m - s_m
        for leg in self._legs[self._number + 1 :]:
            if left_m >= way_m:
                break
            pieces.append(leg.xy[(leg.s > 0) & (leg.s <= way_m)])
            left_m += leg.length_m
        return np.vstack(pieces)

    @property
    def leg_left_m(self) -> float:
        """Way to the end of the leg."""
        return 0.0 if self._pursuit is None else self._pursuit.leg.length_m - self._pursuit.s_m

    def skip_corner(self, pose: Array) -> None:
        """Continue with the next leg where the base, on a detour, has reached it without the end of this one."""
        pursuit = self._pursuit
        if pursuit is None or self._number + 1 >= len(self._legs) or self.leg_left_m > SKIP_M:
            return
        leg = self._legs[self._number + 1]
        near_m = np.hypot(leg.xy[:, 0] - pose[0], leg.xy[:, 1] - pose[1])
        k = int(np.argmin(np.where(leg.s <= SKIP_M, near_m, np.inf)))
        if near_m[k] < SKIP_BESIDE_M < abs(pursuit.leg.offset_m(pose, pursuit.s_m)):
            self._number += 1
            self._pursuit = Pursuit(leg, self._settings.pursuit, float(leg.s[k]))

    def step(
        self, stamp_ns: int, pose: Array, speed_mps: float, yaw_rate_radps: float, obstacle_m: float = math.inf
    ) -> Following:
        """Return the motion at a pose (3,) with its measured speeds."""
        # 1. Predict the pose at which the command takes effect.
        at_effect = predicted(pose, speed_mps, yaw_rate_radps, self._settings.pursuit.delay_s)
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
        end_m = 0.25 * self._settings.goal_cm * 0.01 if is_last else CORNER_M
        if approach.left_m > end_m or approach.turning:
            left_m = approach.left_m + sum(leg.length_m for leg in self._legs[self._number + 1 :])
            return Following(approach.setpoint, left_m, approach.offset_m, approach.turning)
        if is_last:
            self._pursuit = None
            return None
        self._number += 1
        self._pursuit = Pursuit(self._legs[self._number], self._settings.pursuit)
        left_m = sum(leg.length_m for leg in self._legs[self._number :])
        return Following(STAND, left_m, approach.offset_m, True)

    def _align(self, pose: Array, speed_mps: float, yaw_rate_radps: float) -> Following:
        """Turn to the heading of the goal on the spot; then drive the distance that is missing, or end."""
        goal_rad, missing = self.path.final_heading_rad, self.path.goal - pose[:2]
        missing_m = float(np.hypot(*missing))
        error_rad = 0.0 if goal_rad is None else wrap_angle(goal_rad - float(pose[2]))
        is_at_rest = abs(speed_mps) < SETTLED_MPS and abs(yaw_rate_radps) < SETTLED_RADPS
        within = abs(error_rad) <= math.radians(self._settings.goal_deg)
        self._settled = self._settled + 1 if is_at_rest and within else 0
        setpoint = STAND if goal_rad is None else Setpoint(0.0, goal_rad)
        if self._settled < SETTLED:
            return Following(setpoint, missing_m, 0.0, True)
        if missing_m <= self._settings.goal_cm * 0.01 or self._corrections >= CORRECTIONS:
            return Following(STAND, 0.0, 0.0, False, True, missing_m)
        self._corrections += 1
        self._settled = 0
        aside_rad = abs(wrap_angle(math.atan2(missing[1], missing[0]) - float(pose[2])))
        self._legs = [straight_leg(pose, self.path.goal, backwards=aside_rad > BEHIND_RAD)]
        self._number, self._pursuit = 0, Pursuit(self._legs[0], self._settings.pursuit)
        return Following(STAND, missing_m, 0.0, True)
