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
from omnid.core.control.collision_monitor import UNKNOWN, CollisionSettings
from omnid.core.control.command_sources import PLANNER
from omnid.core.control.heading_controller import Setpoint, wrap_angle
from omnid.core.control.safety_rules import ASKED
from omnid.core.navigation.follower import STAND, Follower, Following
from omnid.core.navigation.giving_way import GivingWay, Phase, Trail, closed, give_way, is_free
from omnid.core.navigation.local_planner import Detour, LocalPlanner
from omnid.core.navigation.path import DrivePath
from omnid.core.navigation.requests import NavigationFrame
from omnid.core.navigation.settings import NavigationSettings
from omnid.core.navigation.situation import NOWHERE, UNKNOWN_M, Situation, refusal_of_map, refusal_to_drive
from omnid.navigation_state import NavigationState
from omnid.tracking_state import MapState, TrackingState

Array = NDArray[np.float64]

PROGRESS_M, PROGRESS_RAD = 0.05, math.radians(5)  # A smaller motion is no progress; by trial on development seeds.


@dataclass(slots=True)
class Drive:
    """A drive from its start to its end."""

    task: str  # description in words
    frame: NavigationFrame
    paths: list[DrivePath]  # paths that are driven one after the other
    follower: Follower
    resets: int
    command_ns: int = 0  # stamp of the request
    paused: str = ""  # reason of the pause; empty: it is not paused
    waits: dict[NavigationState, float] = field(default_factory=dict)  # durations [s] of the waits by their reason
    halts: int = 0  # WheelState.halts at the start, or when a person let it go on
    unlocalised_m: float = 0.0  # distance driven since the pose in the map was known
    localised_ns: int = -1  # stamp of that pose
    nearest_m: float = math.inf  # length of the path that was left at the last progress
    heading_rad: float = 0.0  # heading at the last progress
    stuck_s: float = 0.0  # time since the last progress
    last_xy: Array | None = None  # last position in odom
    giving_way: GivingWay | None = None  # None unless the base gives way now
    gave_way: int = 0  # number of times that the base gave way at the last block
    gave_way_m: float = math.inf  # length of the path that was left at that block
    around_unknown: bool = False  # floor that was not seen has stopped the base: it is an obstacle until it is passed

    def obstacles(self, now: Situation) -> Array:
        """Return what the base must not come near (N, 2), in odom."""
        known = NOWHERE if now.obstacles is None else now.obstacles
        return np.vstack([known, now.unknown]) if self.around_unknown else known

    def path_ahead(self, now: Situation, way_m: float) -> Array:
        """Return the path (N, 2) ahead, in odom."""
        T_odom_frame = relative(now.T_frame_odom(self.frame), np.zeros(3))
        ahead = self.follower.path_ahead(way_m)
        path = composed(np.repeat(T_odom_frame[None], len(ahead), 0), np.column_stack([ahead, np.zeros(len(ahead))]))
        return np.asarray(path[:, :2])

    def in_odom(self, setpoint: Setpoint, now: Situation) -> Setpoint:
        """Return a setpoint whose heading is in odom."""
        if setpoint.heading_rad is None:
            return setpoint
        turned_rad = float(now.T_frame_odom(self.frame)[2])
        return Setpoint(setpoint.velocity_mps, wrap_angle(setpoint.heading_rad - turned_rad))

    def stands_since_s(self, pose: Array, left_m: float, dt_s: float) -> float:
        """Return the time since the last progress, which is a shorter way left or a turn; dt_s: since the last call."""
        turned_rad = abs(wrap_angle(float(pose[2]) - self.heading_rad))
        if left_m < self.nearest_m - PROGRESS_M or turned_rad > PROGRESS_RAD:
            self.nearest_m, self.heading_rad, self.stuck_s = left_m, float(pose[2]), 0.0
        else:
            self.stuck_s += dt_s
        return self.stuck_s


class Navigation(NamedTuple):
    """The result of a step."""

    setpoint: Setpoint | None  # setpoint in odom; None: nothing is sent
    state: NavigationState
    reason: str
    left_m: float = math.nan  # way to the end of the path
    offset_m: float = math.nan  # distance of the base to the left of the path


STOPS: Final = 5  # A stop is sent at so many poses after the end of a drive, because one might be lost.
BESIDE_M: Final = 0.3  # The path counts as left this far beyond the corridor; by trial on development seeds.
PLANNED_M: Final = 4.0  # Length of the path that the local planner is given, because its grid ends at 3.2 m.
LONGEST_STEP_S: Final = 1.0  # A longer time between two poses counts as this, because a gap is no wait.
RESUME: Final = "`omnid goto --resume` (it arms, too)"  # the one command after a fault or a pause
AROUND: Final = "it looks for a way around an obstacle"
GIVES_WAY: Final = "it drives back to let others pass"
WAITS: Final = "it goes on by itself when the way is free"
AGAIN_M: Final = 1.0  # After this progress the next block is a new one; by trial on development seeds.
MOST_DOUBLINGS: Final = 6  # Most doublings of the time until the base gives way again: to four minutes by default.
PAST_M: Final = 1.0  # Length of the path past the block that must be free, too; by trial on development seeds.


class Navigator:
    """Holds the present drive, if there is one."""

    def __init__(self, settings: NavigationSettings, collision: CollisionSettings | None = None) -> None:
        """collision: the outline of the base; None: the default one."""
        self._settings = settings
        collision = collision or CollisionSettings()
        self._planner = LocalPlanner(settings, collision)
        self._half_width_m = collision.half_width_m + collision.side_m
        self._trail = Trail(settings.give_way_m)
        self._last_ns: int | None = None
        self._stops = 0  # number of stops that are still to be sent
        self.drive: Drive | None = None
        self.state = NavigationState.IDLE
        self.reason = ""
        self.task = ""  # description of the drive, kept after its end
        self.command_ns = 0  # stamp of the request for the drive

    @property
    def stopping(self) -> bool:
        """True if a stop is to be sent."""
        return self._stops > 0 or (self.drive is not None and bool(self.drive.paused))

    def start(
        self, task: str, frame: NavigationFrame, paths: list[DrivePath], now: Situation, command_ns: int = 0
    ) -> None:
        """Begin a drive, which replaces the one before."""
        self._planner.restart()
        self._trail.restart()
        self.drive = Drive(
            task,
            frame,
            paths,
            Follower(paths[0], self._settings),
            now.resets,
            command_ns,
            halts=now.wheels.halts,
            heading_rad=float(now.pose[2]),
        )
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
            self.drive.paused, self.drive.halts = "", now.wheels.halts
            self.drive.waits.clear()
            self.drive.stuck_s = 0.0
        return refusal

    def step(self, now: Situation) -> Navigation:
        """Return the motion for a new pose, and the state with its reason."""
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
        # 3. Giving way, while it lasts.
        if drive.giving_way is not None:
            return self._give_way(drive, drive.giving_way, now, dt_s)
        # 4. The path.
        pose = now.pose_in(drive.frame)
        following = drive.follower.step(now.stamp_ns, pose, now.speed_mps, now.yaw_rate_radps, now.obstacle_m)
        if following.done:
            return self._finished(drive, following.missed_m)
        if self._is_beside(following):
            return self._taken_away(following)
        setpoint = drive.in_odom(following.setpoint, now)
        # 5. Obstacles, and a safety rule that holds the wheels because of one.
        drive.around_unknown |= now.wheels.held_by == UNKNOWN
        path, leg_m = drive.path_ahead(now, PLANNED_M), drive.follower.leg_left_m
        plan = self._around_obstacles(drive, path, leg_m, now, setpoint)
        drive.around_unknown &= plan.avoiding or bool(now.wheels.held_by)
        if plan.avoiding:
            drive.follower.skip_corner(pose)
        if plan.setpoint is None:
            return self._blocked(drive, plan.reason, now, following, dt_s)
        if now.wheels.held_by:  # the setpoint is still sent: the monitor lets go by itself
            return self._blocked(drive, now.wheels.held_by, now, following, dt_s)._replace(setpoint=plan.setpoint)
        # 6. Progress: where it is missing for too long, the base gives way or the drive fails.
        if self._is_stuck(drive, now, following, dt_s):
            if plan.avoiding and not drive.gave_way and self._begins_to_give_way(drive, now, following.left_m):
                return self._wait(drive, NavigationState.BLOCKED, AROUND, dt_s)
            return self._no_progress(now, AROUND if plan.avoiding else "")
        self.state = NavigationState.AVOIDING if plan.avoiding else NavigationState.DRIVING
        self.reason = now.wheels.reason if now.wheels.is_held else plan.reason
        drive.waits.clear()
        return Navigation(plan.setpoint, self.state, self.reason, following.left_m, following.offset_m)

    def _idle(self) -> Navigation:
        if self._stops:
            self._stops -= 1
            return Navigation(STAND, self.state, self.reason)
        return Navigation(None, self.state, self.reason)

    def _check_wheels(self, drive: Drive, now: Situation) -> None:
        wheels = now.wheels
        # Between two poses it may have been armed again, which alone moves nothing.
        by = wheels.halted_by if wheels.halts != drive.halts else wheels.disarmed_by if wheels.needs_request else ""
        if by == ASKED:
            self._end(NavigationState.CANCELLED, ASKED)
        elif by:
            drive.paused = f"disarmed: {by}: see to it, then {RESUME}"

    def _advance(self, drive: Drive, now: Situation) -> None:
        """Add the pose to the trail, and its way to that without a pose in the map; begin again after a reset."""
        moved_m = 0.0 if drive.last_xy is None else float(np.hypot(*(now.pose[:2] - drive.last_xy)))
        drive.last_xy = now.pose[:2].copy()
        drive.unlocalised_m += moved_m
        if drive.giving_way is None:
            self._trail.add(now.pose, now.speed_mps)
        if drive.resets != now.resets:
            self._trail.restart()
            drive.giving_way = None
            drive.resets, drive.unlocalised_m = now.resets, math.inf
            if drive.frame is NavigationFrame.ODOM:
                self._end(NavigationState.FAILED, "odometry has lost its map and begun again: ask again")
        in_map = now.in_map
        if in_map is None or in_map.stamp_ns <= drive.localised_ns:  # no new pose in the map has come
            return
        if in_map.state is MapState.LOCALIZED and in_map.sigma_m <= self._settings.map_sigma_m:
            drive.unlocalised_m, drive.localised_ns = 0.0, in_map.stamp_ns
        elif in_map.sigma_m > UNKNOWN_M:
            drive.unlocalised_m = math.inf

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
        """Stand and count the time; fail where the pose in the map is missing for too long."""
        if self.drive is None:
            return self._idle()
        drive.waits[state] = drive.waits.get(state, 0.0) + dt_s
        longest_s = self._settings.unlocalised_s
        if state is NavigationState.NOT_LOCALISED and drive.waits[state] > longest_s:
            return self._failed(f"{state} for {longest_s:g} s: {reason}")
        self.state, self.reason = state, reason
        setpoint = None if state is NavigationState.PAUSED else STAND
        return Navigation(setpoint, state, reason)

    def _blocked(self, drive: Drive, reason: str, now: Situation, following: Following, dt_s: float) -> Navigation:
        """Wait for a free way, and give way where that takes too long."""
        waiting = self._wait(drive, NavigationState.BLOCKED, f"{reason}: {WAITS}", dt_s)
        if following.left_m < drive.gave_way_m - AGAIN_M:
            drive.gave_way = 0
        patience_s = self._settings.give_way_s * 2.0 ** min(drive.gave_way, MOST_DOUBLINGS)
        if drive.waits[NavigationState.BLOCKED] > patience_s:
            self._begins_to_give_way(drive, now, following.left_m)
        return waiting._replace(left_m=following.left_m, offset_m=following.offset_m)

    def _begins_to_give_way(self, drive: Drive, now: Situation, left_m: float) -> bool:
        """Begin to drive back; False where there is no free way back, or it is switched off."""
        drive.waits[NavigationState.BLOCKED] = drive.stuck_s = 0.0
        if now.obstacles is None or not self._settings.give_way_m:
            return False
        obstacles = drive.obstacles(now)
        drive.giving_way = give_way(self._trail, self._settings, now.pose, now.stamp_ns, obstacles, self._half_width_m)
        if drive.giving_way is not None:
            drive.gave_way, drive.gave_way_m, drive.nearest_m = drive.gave_way + 1, left_m, math.inf
        return drive.giving_way is not None

    def _give_way(self, drive: Drive, giving: GivingWay, now: Situation, dt_s: float) -> Navigation:
        """Drive back, rest, and come again to the place where the base was blocked. All in odom."""
        obstacles = drive.obstacles(now)
        motion = now.stamp_ns, now.pose, now.speed_mps, now.yaw_rate_radps
        following = None if giving.phase is Phase.REST else giving.drive(*motion)
        if following is not None and self._is_beside(following):
            return self._taken_away(following)
        # 1. Back, as far as it is seen to be free now.
        if giving.phase is Phase.BACK:
            is_closed = now.obstacles is None or closed(giving.look_back(), obstacles, self._half_width_m).any()
            if following is not None and not is_closed and not now.wheels.held_by:
                if self._is_stuck(drive, now, following, dt_s):
                    return self._no_progress(now, GIVES_WAY)
                self.state, self.reason = NavigationState.AVOIDING, GIVES_WAY
                return Navigation(following.setpoint, self.state, self.reason, drive.gave_way_m)
            giving.rest()
            drive.nearest_m = math.inf
        # 2. Wait until the way is free, or it is time to search for another one.
        if giving.phase is Phase.REST:
            way = np.vstack([giving.way_to_block(now.pose), drive.path_ahead(now, PAST_M)])
            room_m = self._half_width_m + self._settings.clearance_m
            if giving.move_on(now.pose, dt_s, is_free(way, obstacles, room_m)):
                return self._wait(drive, NavigationState.BLOCKED, f"it gives way: {WAITS}", dt_s)
        # 3. To the place where it was blocked.
        elif following is not None:
            path, leg_m = giving.follower.path_ahead(PLANNED_M), giving.follower.leg_left_m
            plan = self._around_obstacles(drive, path, leg_m, now, following.setpoint)
            if plan.setpoint is None or now.wheels.held_by:
                giving.rest()
                drive.nearest_m = math.inf
                return self._wait(drive, NavigationState.BLOCKED, plan.reason or now.wheels.held_by, dt_s)
            if self._is_stuck(drive, now, following, dt_s):
                return self._no_progress(now, AROUND if plan.avoiding else "")
            self.state = NavigationState.AVOIDING if plan.avoiding else NavigationState.DRIVING
            self.reason = plan.reason
            return Navigation(plan.setpoint, self.state, self.reason, drive.gave_way_m)
        drive.giving_way, drive.nearest_m = None, math.inf
        drive.waits.clear()
        return Navigation(STAND, self.state, self.reason, drive.gave_way_m)

    def _around_obstacles(self, drive: Drive, path: Array, leg_m: float, now: Situation, wanted: Setpoint) -> Detour:
        """Return the motion, by way of a detour where the path (N, 2) in odom is blocked; leg_m: to its next corner."""
        if now.obstacles is None:
            return Detour(wanted, False)
        return self._planner.plan(
            now.pose,
            path,
            now.obstacles,
            wanted,
            unknown=now.unknown if drive.around_unknown else NOWHERE,
            moving=now.moving,
            leg_left_m=leg_m,
            speed_mps=now.speed_mps,
        )

    def _is_stuck(self, drive: Drive, now: Situation, following: Following, dt_s: float) -> bool:
        """True if for too long the base has neither come nearer to the end nor turned."""
        return drive.stands_since_s(now.pose, following.left_m, dt_s) > self._settings.stuck_s

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

    def _is_beside(self, following: Following) -> bool:
        """True if the base is no longer near its path, for example because an operator has taken it away."""
        return abs(following.offset_m) > self._settings.corridor_m + BESIDE_M

    def _taken_away(self, following: Following) -> Navigation:
        return self._failed(f"{abs(following.offset_m):.1f} m beside the path: drive back to it and ask again")

    def _no_progress(self, now: Situation, does: str) -> Navigation:
        why = now.wheels.reason if now.wheels.is_held else does
        words = f"no progress for {self._settings.stuck_s:g} s", why, "look at the robot"
        return self._failed(": ".join(word for word in words if word))

    def _failed(self, reason: str) -> Navigation:
        self._end(NavigationState.FAILED, reason)
        return self._idle()

    def _end(self, state: NavigationState, reason: str) -> None:
        self.drive, self._stops = None, STOPS
        self.state, self.reason = state, reason
