"""State machine of the navigation: from requests and poses to setpoints, with the reason for each halt.

Every end is a stop. Time is that of the poses. A drive in the frame map follows the corrections of the map.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from calib.se2_arrays import composed, relative
from omnid.core.control.collision_settings import CollisionSettings
from omnid.core.control.command_sources import PLANNER
from omnid.core.control.heading_controller import Setpoint, wrap_angle
from omnid.core.control.safety_rules import ASKED, COMMAND_STALE, IDLE
from omnid.core.navigation.follower import STAND, Follower
from omnid.core.navigation.local_planner import Detour, LocalPlanner
from omnid.core.navigation.path import DrivePath
from omnid.core.navigation.requests import NavigationFrame
from omnid.core.navigation.settings import NavigationSettings
from omnid.core.navigation.situation import Situation, refusal_of_map, refusal_to_drive
from omnid.navigation_state import NavigationState
from omnid.tracking_state import MapState, TrackingState

Array = NDArray[np.float64]

STOPS: Final = 5  # poses after an end at which a stop is sent: one might be lost
PROGRESS_M, PROGRESS_RAD = 0.05, math.radians(5)  # by trial on development seeds
BESIDE_M: Final = 0.3  # beyond the corridor, at which the path counts as left; by trial on development seeds
PLANNED_M: Final = 4.0  # of the path that the local planner is given; enough: its grid ends at 3.2 m
LONGEST_STEP_S: Final = 1.0  # a gap between two poses counts as no more
RESUME: Final = "`omnid goto --resume` (it arms, too)"  # the one command after a fault or a pause
AROUND: Final = "it looks for a way around an obstacle"


@dataclass(slots=True)
class Drive:
    """A drive that is under way."""

    task: str  # in words
    frame: NavigationFrame
    paths: list[DrivePath]  # one after the other
    follower: Follower
    resets: int
    command_ns: int = 0  # stamp of the request
    paused: str = ""  # the reason; empty: it is not paused
    waits: dict[NavigationState, float] = field(default_factory=dict)  # s, by what is waited for
    unlocalised_m: float = 0.0  # way since the pose in the map was known
    nearest_m: float = math.inf  # way left, at the last progress
    heading_rad: float = 0.0  # at the last progress
    stuck_s: float = 0.0  # since then
    last_xy: Array | None = None  # in odom


class Navigation(NamedTuple):
    """The result of a step."""

    setpoint: Setpoint | None  # in odom; None: nothing is sent
    state: NavigationState
    reason: str
    left_m: float = math.nan  # way to the end of the path
    offset_m: float = math.nan  # of the base to the left of the path


class Navigator:
    """Holds the drive that is under way, if there is one."""

    def __init__(self, settings: NavigationSettings, collision: CollisionSettings | None = None) -> None:
        """collision: the outline of the base; None: the default one."""
        self._settings = settings
        self._planner = LocalPlanner(settings, collision or CollisionSettings())
        self._last_ns: int | None = None
        self._stops = 0  # still to be sent
        self.drive: Drive | None = None
        self.state = NavigationState.IDLE
        self.reason = ""
        self.task = ""  # of the drive, also after its end
        self.command_ns = 0

    @property
    def stopping(self) -> bool:
        """True if a stop is to be sent."""
        return self._stops > 0 or (self.drive is not None and bool(self.drive.paused))

    def start(self, task: str, frame: NavigationFrame, paths: list[DrivePath], now: Situation, command_ns: int = 0
              ) -> None:
        """Begin a drive, which replaces the one before."""
        self._planner.restart()
        self.drive = Drive(task, frame, paths, Follower(paths[0], self._settings), now.resets, command_ns,
                           heading_rad=float(now.pose[2]))
        self.task, self.command_ns, self._stops = task, command_ns, 0
        self.state, self.reason = NavigationState.DRIVING, ""

    def cancel(self, reason: str) -> None:
        """End the drive."""
        if self.drive is not None:
            self._end(NavigationState.CANCELLED, reason)

    def pause(self, reason: str) -> None:
        """Halt until `resume`."""
        if self.drive is not None:
            self.drive.paused = self.drive.paused or reason
            self.state, self.reason = NavigationState.PAUSED, self.drive.paused

    def resume(self, now: Situation) -> str:
        """Go on; return the reason where it cannot."""
        if self.drive is None:
            return "nothing is under way: give a goal, or repeat a route"
        refusal = refusal_to_drive(now, NavigationFrame.ODOM, math.inf)
        if not refusal:
            self.drive.paused = ""
            self.drive.waits.clear()
            self.drive.stuck_s = 0.0
        return refusal

    def step(self, now: Situation) -> Navigation:
        """Return the motion at a pose."""
        dt_s = 0.0 if self._last_ns is None else min(max((now.stamp_ns - self._last_ns) * 1e-9, 0.0), LONGEST_STEP_S)
        self._last_ns = now.stamp_ns
        drive = self.drive
        if drive is None:
            return self._idle()
        # 1. The wheels: a stop ends the drive, a fault that needs a person pauses it.
        self._check_wheels(drive, now)
        if self.drive is None:
            return self._idle()
        # 2. The pose: without it nothing is sent, and the wheels stop.
        self._advance(drive, now)
        halt = self._halt(drive, now)
        if halt is not None:
            return self._wait(drive, *halt, dt_s)
        # 3. The path.
        pose = now.pose_in(drive.frame)
        following = drive.follower.step(now.stamp_ns, pose, now.speed_mps, now.yaw_rate_radps, now.obstacle_m)
        if following.done:
            return self._finished(drive, following.missed_m)
        if abs(following.offset_m) > self._settings.corridor_m + BESIDE_M:
            return self._failed(f"{abs(following.offset_m):.1f} m beside the path: drive back to it and ask again")
        setpoint = self._in_odom(following.setpoint, drive, now)
        # 4. Obstacles.
        plan = self._around_obstacles(drive, now, setpoint)
        if plan.setpoint is None:
            return self._wait(drive, NavigationState.BLOCKED, plan.reason, dt_s)._replace(
                left_m=following.left_m, offset_m=following.offset_m)
        if now.wheels.held_by:  # the setpoint is still sent: the monitor lets go by itself
            held = self._wait(drive, NavigationState.BLOCKED, now.wheels.held_by, dt_s)
            return held._replace(setpoint=plan.setpoint if self.drive else held.setpoint, left_m=following.left_m,
                                 offset_m=following.offset_m)
        # 5. What holds the wheels, and progress.
        if self._is_stuck(drive, now, following.left_m, dt_s):
            why = now.wheels.reason if _holds(now) else AROUND if plan.avoiding else ""
            return self._failed(f"no progress for {self._settings.stuck_s:g} s{': ' + why if why else ''}: look at the "
                                "robot")
        self.state = NavigationState.AVOIDING if plan.avoiding else NavigationState.DRIVING
        self.reason = now.wheels.reason if _holds(now) else plan.reason
        drive.waits.clear()
        return Navigation(plan.setpoint, self.state, self.reason, following.left_m, following.offset_m)

    def _idle(self) -> Navigation:
        if self._stops:
            self._stops -= 1
            return Navigation(STAND, self.state, self.reason)
        return Navigation(None, self.state, self.reason)

    def _check_wheels(self, drive: Drive, now: Situation) -> None:
        wheels = now.wheels
        if wheels.armed or not wheels.needs_request:
            return
        if wheels.disarmed_by == ASKED:
            self._end(NavigationState.CANCELLED, ASKED)
        else:
            drive.paused = f"disarmed: {wheels.disarmed_by}: see to it, then {RESUME}"

    def _advance(self, drive: Drive, now: Situation) -> None:
        """Sum up the way since the pose in the map was known."""
        moved_m = 0.0 if drive.last_xy is None else float(np.hypot(*(now.pose[:2] - drive.last_xy)))
        drive.last_xy = now.pose[:2].copy()
        drive.unlocalised_m += moved_m
        if drive.resets != now.resets:
            drive.resets, drive.unlocalised_m = now.resets, math.inf
            if drive.frame is NavigationFrame.ODOM:
                self._end(NavigationState.FAILED, "odometry has lost its map and begun again: ask again")
        if now.in_map is not None and now.in_map.state is MapState.LOCALIZED \
                and now.in_map.sigma_m <= self._settings.map_sigma_m:
            drive.unlocalised_m = 0.0

    def _halt(self, drive: Drive, now: Situation) -> tuple[NavigationState, str] | None:
        """Return why the base must wait at this pose."""
        if self.drive is None:
            return self.state, self.reason
        if drive.paused:
            return NavigationState.PAUSED, drive.paused
        if now.state is TrackingState.LOST:
            return NavigationState.NOT_LOCALISED, "odometry is lost"
        if drive.frame is NavigationFrame.MAP and drive.unlocalised_m > self._settings.unlocalised_m:
            reason = refusal_of_map(now, self._settings.map_sigma_m)
            return NavigationState.NOT_LOCALISED, reason.partition(":")[0] or "not localised"
        if now.wheels.source not in ("", PLANNER):
            return NavigationState.PAUSED, f"{now.wheels.source} drives: it goes on when that ends"
        return None

    def _wait(self, drive: Drive, state: NavigationState, reason: str, dt_s: float) -> Navigation:
        """Stand and count the time; fail where it is over."""
        if self.drive is None:
            return self._idle()
        longest_s = {NavigationState.BLOCKED: self._settings.blocked_s,
                     NavigationState.NOT_LOCALISED: self._settings.unlocalised_s}.get(state, math.inf)
        drive.waits[state] = drive.waits.get(state, 0.0) + dt_s
        if drive.waits[state] > longest_s:
            return self._failed(f"{state} for {longest_s:g} s: {reason}")
        self.state, self.reason = state, reason
        setpoint = None if state is NavigationState.PAUSED else STAND
        return Navigation(setpoint, state, reason)

    def _around_obstacles(self, drive: Drive, now: Situation, setpoint: Setpoint) -> Detour:
        """Return the motion, by way of a detour where the path is blocked."""
        if now.obstacles is None:
            return Detour(setpoint, False)
        T_odom_frame = relative(now.T_frame_odom(drive.frame), np.zeros(3))
        ahead = drive.follower.path_ahead(PLANNED_M)
        path = composed(np.repeat(T_odom_frame[None], len(ahead), 0), np.column_stack([ahead, np.zeros(len(ahead))]))
        detour = self._planner.plan(now.pose, path[:, :2], now.obstacles, setpoint, moving=now.moving,
                                    leg_left_m=drive.follower.leg_left_m, speed_mps=now.speed_mps)
        if detour.avoiding:
            drive.follower.skip_corner(now.pose_in(drive.frame))
        return detour

    def _in_odom(self, setpoint: Setpoint, drive: Drive, now: Situation) -> Setpoint:
        if setpoint.heading_rad is None:
            return setpoint
        turned_rad = float(now.T_frame_odom(drive.frame)[2])
        return Setpoint(setpoint.velocity_mps, wrap_angle(setpoint.heading_rad - turned_rad))

    def _is_stuck(self, drive: Drive, now: Situation, left_m: float, dt_s: float) -> bool:
        """True if the base has come neither nearer to the end nor turned for too long."""
        turned_rad = abs(wrap_angle(float(now.pose[2]) - drive.heading_rad))
        if left_m < drive.nearest_m - PROGRESS_M or turned_rad > PROGRESS_RAD:
            drive.nearest_m, drive.heading_rad, drive.stuck_s = left_m, float(now.pose[2]), 0.0
        else:
            drive.stuck_s += dt_s
        return drive.stuck_s > self._settings.stuck_s

    def _finished(self, drive: Drive, missed_m: float) -> Navigation:
        """Begin the next path, or end."""
        if len(drive.paths) > 1:
            del drive.paths[0]
            drive.follower = Follower(drive.paths[0], self._settings)
            drive.nearest_m = math.inf
            return Navigation(STAND, self.state, self.reason, drive.paths[0].length_m, 0.0)
        if missed_m > self._settings.goal_cm * 0.01:
            return self._failed(f"the goal is missed by {100 * missed_m:.1f} cm")
        self._end(NavigationState.REACHED, "")
        return self._idle()._replace(left_m=0.0)

    def _failed(self, reason: str) -> Navigation:
        self._end(NavigationState.FAILED, reason)
        return self._idle()

    def _end(self, state: NavigationState, reason: str) -> None:
        self.drive, self._stops = None, STOPS
        self.state, self.reason = state, reason


def _holds(now: Situation) -> bool:
    """True if a rule of the controller holds the wheels now."""
    return now.wheels.reason not in ("", IDLE, COMMAND_STALE)
