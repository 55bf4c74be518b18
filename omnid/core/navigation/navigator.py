"""State machine of the navigation: from requests and poses to setpoints, with the reason for each stop.

Every end is a stop. Time is that of the poses. A drive in the frame map follows the corrections of the map. At each
pose there is one decision: the base follows its way, which is the path that was asked for; where that is not free,
the planner searches another one, to the goal or back to the path; while there is none, the base waits.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Final, NamedTuple

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray

from calib.se2_arrays import composed, relative
from omnid.core.control.collision_monitor import CollisionSettings
from omnid.core.control.command_sources import PLANNER
from omnid.core.control.heading_controller import Setpoint, wrap_angle
from omnid.core.control.safety_rules import ASKED
from omnid.core.navigation.follower import BRAKE_SHARE, STAND, TURN_RAD, Follower, Following
from omnid.core.navigation.path import STEP_M, DrivePath, drive_path
from omnid.core.navigation.planner import Planner, Surroundings
from omnid.core.navigation.requests import NavigationFrame
from omnid.core.navigation.settings import NavigationSettings
from omnid.core.navigation.situation import Situation, refusal_of_map, refusal_to_drive
from omnid.navigation_state import NavigationState
from omnid.tracking_state import TrackingState

Array = NDArray[np.float64]

LOOK_M: Final = 2.0  # Length of the way ahead that must be free; twice that is searched for a free place behind.
REJOIN: Final = 6  # Free points of the path behind an obstacle, at the last of which a way around it ends.
# Time between two searches for a way while the present one is blocked, and for a shorter one while it is free.
AGAIN_S, SHORTER_S = 0.5, 2.0
BETTER: Final = 0.8  # A way replaces one that is free only if it is shorter than this share of it.
MOST_WAYS: Final = 6  # Most ways that are tried without coming NEARER_M nearer to the end.
STOPS: Final = 5  # A stop is sent at so many poses after the end of a drive, because one might be lost.
NEARER_M: Final = 1.0  # After this progress the next block is a new one.

RESUME: Final = "`omnid goto --resume` (it arms, too)"  # the one command after a fault or a pause
WAITS: Final = "it goes on by itself when the way is free"
OBSTACLE: Final = "an obstacle is on the path"
CROSSES: Final = "somebody or something crosses the path"


@dataclass(slots=True)
class Drive:
    """A drive from its start to its end."""

    task: str  # description in words
    frame: NavigationFrame
    paths: list[DrivePath]  # paths that are driven one after the other
    follower: Follower  # of the first of them, or of a way around something that leads to its end
    resets: int
    stop_count: int  # WheelState.stop_count at the start, or when a person resumed it
    pose: Array  # (3,) last one in odom
    T_odom_frame: Array  # (3,) by which the way of the follower is in odom
    moved_from: Array  # (3,) pose in odom at the last progress
    around_m: float = 0.0  # length of the way that is not of the path
    paused: str = ""  # reason of the pause; empty: it is not paused
    waited_s: float = 0.0  # for the pose in the map
    unlocalised_m: float = 0.0  # distance driven since the pose in the map was known
    localised_ns: int = -1  # stamp of that pose
    stuck_s: float = 0.0  # time since the last progress
    # Since the way that was left was shorter by NEARER_M for the last time:
    least_m: float = math.inf  # that length
    blocked_s: float = 0.0  # time for which no way was free
    around_s: float = 0.0  # time on ways around something
    ways: int = 0  # number of these ways
    barred: list[Array] = field(default_factory=list)  # points (N, 2) in odom where the collision monitor stopped it
    searched_s: float = -math.inf  # stamp of the last search
    no_way: str = ""  # why that search found none

    @property
    def avoids(self) -> bool:
        """True while it is off the path, around something."""
        return max(self.follower.s_m, 0.0) < self.around_m

    def drive_along(self, way: DrivePath, settings: NavigationSettings, speed_mps: float, around_m: float) -> None:
        """Follow a way in odom; around_m: length of it that is not of the path."""
        self.follower, self.around_m = Follower(way, settings, speed_mps), around_m


class Navigation(NamedTuple):
    """The result of a step."""

    setpoint: Setpoint | None  # setpoint in odom; None: nothing is sent
    state: NavigationState
    reason: str
    left_m: float = math.nan  # way to the end of the path
    offset_m: float = math.nan  # distance of the base to the left of the path


@dataclass(slots=True)
class Navigator:
    """Holds the present drive, if there is one."""

    settings: NavigationSettings
    collision: CollisionSettings = field(default_factory=CollisionSettings)  # the outline of the base
    drive: Drive | None = None
    state: NavigationState = NavigationState.IDLE
    reason: str = ""
    task: str = ""  # description of the drive, kept after its end
    command_ns: int = 0  # stamp of the request for the drive
    _stops: int = field(default=0, init=False)  # number of stops that are still to be sent
    _last_ns: int = field(default=0, init=False)
    _planner: Planner = field(init=False)

    def __post_init__(self) -> None:
        """Make the tables of the planner."""
        self._planner = Planner(self.settings, self.collision)

    @property
    def stopping(self) -> bool:
        """True if a stop is to be sent."""
        return self._stops > 0 or (self.drive is not None and bool(self.drive.paused))

    def start(
        self, task: str, frame: NavigationFrame, paths: list[DrivePath], now: Situation, command_ns: int = 0
    ) -> None:
        """Begin a drive, which replaces the one before."""
        T_odom_frame, count = now.T_odom_frame(frame), now.wheels.stop_count
        follower = Follower(paths[0].moved(T_odom_frame), self.settings)
        self.drive = Drive(task, frame, paths, follower, now.resets, count, now.pose, T_odom_frame, now.pose)
        self.task, self.command_ns, self._stops = task, command_ns, 0
        self.state, self.reason = NavigationState.DRIVING, ""

    def cancel(self, reason: str) -> None:
        """End the drive."""
        if self.drive is not None:
            self._end(NavigationState.CANCELLED, reason)

    def pause(self, reason: str) -> None:
        """Stop until `resume`."""
        if self.drive is not None:
            self.drive.paused = self.drive.paused or reason
            self.state, self.reason = NavigationState.PAUSED, self.drive.paused

    def resume(self, now: Situation) -> str:
        """Continue a paused drive; return the reason if that is refused, else an empty text."""
        if self.drive is None:
            return "nothing is under way: give a goal, or repeat a route"
        refusal = refusal_to_drive(now, NavigationFrame.ODOM, math.inf)
        if not refusal:
            self.drive.paused, self.drive.stop_count = "", now.wheels.stop_count
            self.drive.waited_s = self.drive.stuck_s = 0.0
        return refusal

    def step(self, now: Situation) -> Navigation:
        """Return the motion for a new pose, and the state with its reason."""
        # A longer time between two poses counts as a second, because a gap is no wait.
        dt_s = min(max((now.stamp_ns - self._last_ns) * 1e-9, 0.0), 1.0) if self._last_ns else 0.0
        self._last_ns, drive, settings = now.stamp_ns, self.drive, self.settings
        if drive is None:
            self._stops, stop = max(self._stops - 1, 0), STAND if self._stops else None
            return Navigation(stop, self.state, self.reason)
        # 1. Wheels, pose, and who else drives: an end is final, everything else is waited for.
        self._follow_map(drive, now)
        state, reason = self._hindrance(drive, now)
        if state.is_end:
            return self._end(state, reason)
        if state is not NavigationState.DRIVING:
            drive.waited_s += dt_s if state is NavigationState.NOT_LOCALISED else 0.0
            if drive.waited_s > settings.unlocalised_s:
                return self._end(NavigationState.FAILED, f"{state} for {settings.unlocalised_s:g} s: {reason}")
            return self._give(None if state is NavigationState.PAUSED else STAND, state, reason)
        drive.resets, drive.waited_s = now.resets, 0.0
        # 2. The motion along the way; another way where that is not free.
        motion, reason = (now.stamp_ns, now.pose, now.speed_mps, now.yaw_rate_radps), ""
        following = drive.follower.step(*motion)
        around, setpoint, held_by = now.around, following.setpoint, now.wheels.held_by
        if around is not None and not drive.follower.aligns and not following.done:
            free_m = self._free_m(drive, now, around)
            if self._takes_other_way(drive, now, around, following, is_blocked=free_m < LOOK_M or bool(held_by)):
                following, held_by = drive.follower.step(*motion), ""
                free_m = self._free_m(drive, now, around)
            # Without one, drive up to the obstacle.
            left_m = free_m - self.collision.front_m - 2 * self.collision.stop_m
            braking_mps = math.sqrt(2 * BRAKE_SHARE * settings.pursuit.acceleration_mps2 * max(left_m, 0.0))
            setpoint = following.setpoint
            if setpoint.velocity_mps > braking_mps:
                share = braking_mps / setpoint.velocity_mps
                setpoint = Setpoint(braking_mps, setpoint.heading_rad, share * setpoint.yaw_rate_radps)
                if braking_mps < settings.pursuit.least_mps:
                    setpoint, reason = STAND, CROSSES if around.moves else OBSTACLE
        # 3. The end of the path.
        if following.done:
            return self._finished(drive, following.left_m)
        if abs(following.offset_m) > settings.corridor_m + self._planner.room_m:
            return self._end(
                NavigationState.FAILED,
                f"{abs(following.offset_m):.1f} m beside the path: drive back to it and ask again",
            )
        # 4. Blocked: it waits, also where a safety rule holds the wheels, which lets go by itself. A goal to which no
        #    way leads fails after a time; paths and routes wait.
        if following.left_m < drive.least_m - NEARER_M:
            drive.least_m, drive.ways, drive.blocked_s, drive.around_s = following.left_m, 0, 0.0, 0.0
            drive.barred.clear()
        drive.around_s += dt_s if drive.avoids else 0.0
        progress = following.left_m, following.offset_m
        if reason or held_by:
            drive.blocked_s += dt_s
            lost_s = drive.blocked_s + (drive.around_s if drive.no_way else 0.0)
            reason = held_by or reason
            if drive.paths[0].is_goal and 0 < settings.give_up_s < lost_s:
                left, why = f"{following.left_m:.1f} m are left", drive.no_way or reason
                return self._end(NavigationState.FAILED, f"no way to the goal, {left}: {why}")
            return self._give(setpoint, NavigationState.BLOCKED, f"{reason}: {WAITS}", *progress)
        # 5. Without any motion for too long, the drive fails.
        moved_m = math.dist(now.pose[:2], drive.moved_from[:2])
        turned_rad = abs(wrap_angle(float(now.pose[2] - drive.moved_from[2])))
        drive.stuck_s += dt_s
        if moved_m > STEP_M or turned_rad > math.radians(5):
            drive.moved_from, drive.stuck_s = now.pose, 0.0
        if drive.stuck_s > settings.stuck_s:
            parts = f"no progress for {settings.stuck_s:g} s", now.wheels.rule, "look at the robot"
            return self._end(NavigationState.FAILED, ": ".join(part for part in parts if part))
        state = NavigationState.AVOIDING if drive.avoids else NavigationState.DRIVING
        return self._give(setpoint, state, now.wheels.rule, *progress)

    def _follow_map(self, drive: Drive, now: Situation) -> None:
        """Move the way with the map; add the motion to that without a pose in the map, which counts once."""
        T_odom_frame = now.T_odom_frame(drive.frame)
        if (T_odom_frame != drive.T_odom_frame).any():
            moved = composed(T_odom_frame[None], relative(drive.T_odom_frame, np.zeros(3)))[0]
            drive.follower.path, drive.T_odom_frame = drive.follower.path.moved(moved), T_odom_frame
        drive.unlocalised_m += float(np.hypot(*(now.pose[:2] - drive.pose[:2])))
        drive.pose, in_map = now.pose, now.in_map
        if drive.resets != now.resets:
            drive.unlocalised_m = math.inf
        if in_map is None or in_map.stamp_ns <= drive.localised_ns:
            return
        if not refusal_of_map(now, self.settings.map_sigma_m):
            drive.unlocalised_m, drive.localised_ns = 0.0, in_map.stamp_ns
        elif in_map.sigma_m > self.settings.reach_m:  # it is not known at all
            drive.unlocalised_m = math.inf

    def _hindrance(self, drive: Drive, now: Situation) -> tuple[NavigationState, str]:
        """Return what ends the drive or what it waits for, and why; DRIVING without anything."""
        wheels, in_odom = now.wheels, drive.frame is NavigationFrame.ODOM
        # A stop or fault that has disarmed the wheels counts also if they were armed again since.
        fault = wheels.disarmed_by if wheels.needs_request else ""
        if wheels.stop_count != drive.stop_count:
            fault = wheels.stopped_by
        if fault == ASKED:
            return NavigationState.CANCELLED, ASKED
        if in_odom and drive.resets != now.resets:
            return NavigationState.FAILED, "odometry has lost its map and begun again: ask again"
        if fault:
            drive.paused = f"disarmed: {fault}: see to it, then {RESUME}"
        if drive.paused:
            return NavigationState.PAUSED, drive.paused
        if now.state is TrackingState.LOST:
            return NavigationState.NOT_LOCALISED, "odometry is lost"
        if not in_odom and drive.unlocalised_m > self.settings.unlocalised_m:
            why = refusal_of_map(now, self.settings.map_sigma_m).partition(":")[0]
            return NavigationState.NOT_LOCALISED, why or "not localised"
        if wheels.source not in ("", PLANNER):
            return NavigationState.PAUSED, f"{wheels.source} drives: it goes on when that ends"
        return NavigationState.DRIVING, ""

    def _free_m(self, drive: Drive, now: Situation, around: Surroundings) -> float:
        """Return the length of the way ahead that is free, up to LOOK_M; on a path with the clearance to obstacles."""
        more_m = 0.0 if drive.avoids else self.settings.clearance_m
        xy = drive.follower.path.xy[drive.follower.ahead(LOOK_M)]
        is_blocked = self._planner.is_blocked(xy, around, around.room, now.stamp_ns, more_m)
        return STEP_M * float(np.argmax(is_blocked)) if is_blocked.any() else math.inf

    def _takes_other_way(
        self, drive: Drive, now: Situation, around: Surroundings, following: Following, *, is_blocked: bool
    ) -> bool:
        """True if the base begins another way, because the present one is blocked, or another one is shorter."""
        settings, way, here, goal = self.settings, drive.follower.path, now.pose[:2], drive.follower.path.goal
        if not settings.corridor_m or not (is_blocked or (drive.avoids and way.is_goal)):
            return False
        # 1. Straight on to a goal, where that is free, with a cell to spare.
        if way.is_goal and not is_blocked:
            straight = drive_path([here, goal], way.final_heading_rad, is_goal=True)
            is_ahead, more_m = (
                abs(wrap_angle(straight.heading[0] - now.pose[2])) < TURN_RAD,
                settings.clearance_m + STEP_M,
            )
            blocked = self._planner.is_blocked(straight.xy, around, around.seen_room, now.stamp_ns, more_m)
            if is_ahead and not blocked.any():
                drive.drive_along(straight, settings, now.speed_mps, 0.0)
                return True
        if now.stamp_ns * 1e-9 - drive.searched_s < (AGAIN_S if is_blocked else SHORTER_S):
            return False
        drive.searched_s = now.stamp_ns * 1e-9
        # 2. Where the collision monitor has stopped the base, the way is closed, although the grid shows it free.
        if now.wheels.held_by:
            outline, v = self.collision, following.setpoint.velocity_mps
            ahead_m = math.copysign((outline.front_m if v > 0 else outline.rear_m) + outline.stop_m, v) if v else 0.0
            beside_m = outline.half_width_m if v else math.hypot(outline.front_m, outline.half_width_m)
            places = np.array([[ahead_m, beside_m, 0.0], [ahead_m, -beside_m, 0.0]])
            drive.barred.append(composed(now.pose[None], places)[:, :2])
        # 3. A way to the goal, or to the first free place on the path behind its obstacle.
        along, heading_rad, join, room = None, math.nan, len(way.s), around.room_with(drive.barred)
        if not way.is_goal:
            ahead = drive.follower.ahead(2 * LOOK_M, drive.around_m)
            is_closed = self._planner.is_blocked(way.xy[ahead], around, room, now.stamp_ns, settings.clearance_m)
            after = int(np.argmax(is_closed))
            runs = sliding_window_view(np.append(~is_closed, np.ones(REJOIN, bool)), REJOIN + 1)
            is_run = np.asarray(runs.all(axis=1))[after:]
            if not is_run.any():
                drive.no_way = "the path is not free within sight"
                return False
            join = ahead.start + min(after + int(np.argmax(is_run)) + REJOIN, len(is_closed) - 1)
            goal = way.xy[join]
            along = drive.paths[0].moved(drive.T_odom_frame).xy
            heading_rad = way.heading[join] + math.pi * (way.speed[join] < 0)
        found = self._planner.way(now.pose, goal, around, room, now.stamp_ns, along, heading_rad)
        if isinstance(found, DrivePath) and is_blocked and drive.ways >= MOST_WAYS:
            found = f"{drive.ways} ways were tried"
        drive.no_way = found if isinstance(found, str) else ""
        if isinstance(found, str) or (not is_blocked and found.length_m > BETTER * following.left_m):
            return False
        # 4. Follow it, and then the rest of the path.
        drive.ways += is_blocked
        xy, speeds = np.vstack([found.xy, way.xy[join:]]), np.append(found.speed, way.speed[join:])
        joined = drive_path(xy, way.final_heading_rad, speeds=speeds, is_goal=way.is_goal)
        drive.drive_along(joined, settings, now.speed_mps, found.length_m)
        return True

    def _finished(self, drive: Drive, missed_m: float) -> Navigation:
        """Begin the next path, or end."""
        if len(drive.paths) > 1:
            del drive.paths[0]
            drive.drive_along(drive.paths[0].moved(drive.T_odom_frame), self.settings, 0.0, 0.0)
            return Navigation(STAND, self.state, self.reason, drive.paths[0].length_m, 0.0)
        if missed_m > self.settings.goal_cm * 0.01:
            return self._end(NavigationState.FAILED, f"the goal is missed by {100 * missed_m:.1f} cm")
        return self._end(NavigationState.REACHED, "")._replace(left_m=0.0)

    def _end(self, state: NavigationState, reason: str) -> Navigation:
        """End the drive, with the first of some stops."""
        self.drive, self._stops = None, STOPS
        return self._give(STAND, state, reason)

    def _give(
        self,
        setpoint: Setpoint | None,
        state: NavigationState,
        reason: str,
        left_m: float = math.nan,
        offset_m: float = math.nan,
    ) -> Navigation:
        self.state, self.reason = state, reason
        return Navigation(setpoint, state, reason, left_m, offset_m)
