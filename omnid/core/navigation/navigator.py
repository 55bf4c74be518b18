"""State machine of the navigation: from requests and poses to setpoints, with the reason for each halt.

Every end is a stop. Time is that of the poses. A drive in the frame map follows the corrections of the map. A goal is
driven to straight on where that way is free, a path along itself; else by a way of the planner, to the goal or back to
the path. What moves is an obstacle where the base would meet it; what closes every way is waited for.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from calib.se2_arrays import composed, relative
from omnid.core.control.collision_monitor import CollisionSettings
from omnid.core.control.command_sources import PLANNER
from omnid.core.control.heading_controller import Setpoint, wrap_angle
from omnid.core.control.safety_rules import ASKED
from omnid.core.navigation.floor_map import CELL_M
from omnid.core.navigation.follower import BRAKE_SHARE, STAND, Follower, Following
from omnid.core.navigation.path import SHORTEST_M, DrivePath, goal_path
from omnid.core.navigation.planner import Move, Planner, Surroundings, distances
from omnid.core.navigation.requests import NavigationFrame
from omnid.core.navigation.settings import NavigationSettings
from omnid.core.navigation.situation import UNKNOWN_M, Situation, refusal_of_map, refusal_to_drive
from omnid.navigation_state import NavigationState
from omnid.tracking_state import MapState, TrackingState

Array = NDArray[np.float64]

PROGRESS_M, PROGRESS_RAD = 0.05, math.radians(5)  # A smaller motion is no progress; by trial on development seeds.
STOPS: Final = 5  # A stop is sent at so many poses after the end of a drive, because one might be lost.
LOOK_M: Final = 2.0  # Length of the way ahead in which obstacles are searched; a free place behind them in twice that.
REJOIN_M: Final = 0.3  # Free length of the path behind an obstacle, at which a detour ends.
# Between two searches where the way is blocked, and where it is free.
AGAIN_NS, SHORTER_NS = 500_000_000, 2_000_000_000
DOCK_M: Final = 0.5  # The last way to a goal is driven straight on.
BETTER: Final = 0.8  # A way replaces one that is free only if it takes less than this share of its time.
MOST_WAYS: Final = 6  # Most ways that are tried without coming NEARER_M nearer to the end.
LONGEST_STEP_S: Final = 1.0  # A longer time between two poses counts as this, because a gap is no wait.
NEARER_M: Final = 1.0  # After this progress the next block is a new one.
ROUNDING_M: Final = 0.005  # Least change of the room between two points of a way.

RESUME: Final = "`omnid goto --resume` (it arms, too)"  # the one command after a fault or a pause
AROUND: Final = "it looks for a way around an obstacle"
WAITS: Final = "it goes on by itself when the way is free"
STANDS: Final = "something stands on the path"
CROSSES: Final = "somebody or something crosses the path"


@dataclass(slots=True)
class Detour:
    """A way of the planner, to the goal or back to the path."""

    follower: Follower  # in odom
    time_s: float  # for all of it
    leg: int  # of the path, to which it leads back
    s_m: float  # on that leg

    def is_at_end(self, following: Following) -> bool:
        """True if the base has driven it; what is missing is less than the distance of points of a path."""
        return following.done or following.left_m < SHORTEST_M


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
    waited_s: float = 0.0  # for the pose in the map
    halts: int = 0  # WheelState.halts at the start, or when a person let it go on
    unlocalised_m: float = 0.0  # distance driven since the pose in the map was known
    localised_ns: int = -1  # stamp of that pose
    nearest_m: float = math.inf  # length of the way that was left at the last progress
    heading_rad: float = 0.0  # heading at the last progress
    stuck_s: float = 0.0  # time since the last progress
    blocked_s: float = 0.0  # time for which no way was found since the base has come nearer to the end
    last_xy: Array | None = None  # last position in odom
    detour: Detour | None = None  # None: it follows the path
    least_m: float = math.inf  # least length of the way that was left, in steps of NEARER_M
    ways: int = 0  # number of ways that were taken since then, each of which was blocked again
    searched_ns: int = -AGAIN_NS  # stamp of the last search
    no_way: str = ""  # why it was in vain
    is_waiting: bool = False  # a way around is known that takes longer than what it has waited is worth

    @property
    def on_way(self) -> Follower:
        """Follower of the detour or the path."""
        return self.follower if self.detour is None else self.detour.follower

    def in_odom(self, xy: Array, now: Situation) -> Array:
        """Return points (N, 2) of the path in odom."""
        T_odom_frame = relative(now.T_frame_odom(self.frame), np.zeros(3))
        path = composed(np.repeat(T_odom_frame[None], len(xy), 0), np.column_stack([xy, np.zeros(len(xy))]))
        return np.asarray(path[:, :2])

    def ahead(self, now: Situation, way_m: float) -> Array:
        """Return the points (N, 2) of the way ahead, in odom."""
        xy = self.on_way.ahead(way_m).xy
        return xy if self.detour is not None else self.in_odom(xy, now)

    def step(self, now: Situation) -> Following:
        """Return the motion along the path or the detour, in odom; at its end the path goes on."""
        motion = now.speed_mps, now.yaw_rate_radps, now.obstacle_m
        if self.detour is not None:
            following = self.detour.follower.step(now.stamp_ns, now.pose, *motion)
            if not self.detour.is_at_end(following):
                return following
            self.rejoin(now)
        following = self.follower.step(now.stamp_ns, now.pose_in(self.frame), *motion)
        heading_rad = following.setpoint.heading_rad
        if heading_rad is None:
            return following
        turned_rad = float(now.T_frame_odom(self.frame)[2])
        setpoint = replace(following.setpoint, heading_rad=wrap_angle(heading_rad - turned_rad))
        return following._replace(setpoint=setpoint)

    def take(self, found: Detour) -> None:
        """Follow a way of the planner from now on."""
        self.detour, self.nearest_m = found, math.inf

    def rejoin(self, now: Situation) -> None:
        """Follow the path from where the detour leads to; to a goal straight on."""
        path, detour, self.nearest_m = self.paths[0], self.detour, math.inf
        leg, s_m = (0, 0.0) if detour is None else (detour.leg, detour.s_m)
        if path.is_goal:
            path, leg, s_m = goal_path(now.pose_in(self.frame), path.goal, path.final_heading_rad), 0, 0.0
        self.detour, self.follower = None, Follower(path, self.follower.settings, leg, s_m, now.speed_mps)

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


class Navigator:
    """Holds the present drive, if there is one."""

    def __init__(self, settings: NavigationSettings, collision: CollisionSettings | None = None) -> None:
        """collision: the outline of the base; None: the default one."""
        self._settings = settings
        collision = collision or CollisionSettings()
        self._planner = Planner(settings, collision)
        self._stands_m = collision.front_m + 2 * collision.stop_m  # where it waits, from the first point of a block
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
        follower, heading_rad = Follower(paths[0], self._settings), float(now.pose[2])
        self.drive = Drive(
            task, frame, paths, follower, now.resets, command_ns, halts=now.wheels.halts, heading_rad=heading_rad
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
            self.drive.waited_s = self.drive.stuck_s = 0.0
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
        # 3. The way.
        following = drive.step(now)
        if following.done:
            return self._finished(drive, following.missed_m)
        if abs(following.offset_m) > self._settings.corridor_m + self._planner.room_m:
            return self._failed(f"{abs(following.offset_m):.1f} m beside the path: drive back to it and ask again")
        if following.left_m < drive.least_m - NEARER_M:
            drive.least_m, drive.ways, drive.blocked_s = following.left_m, 0, 0.0
        # 4. Obstacles on it, and a safety rule that holds the wheels because of one.
        following, setpoint, reason = self._around_obstacles(drive, now, following)
        held_by = now.wheels.held_by
        if setpoint is None or held_by:  # where it is held, the setpoint is still sent: the monitor lets go by itself
            return self._blocked(drive, reason if setpoint is None else held_by, now, following, dt_s, setpoint)
        # 5. Progress: where it is missing for too long, the drive fails.
        avoids = drive.detour is not None
        if drive.stands_since_s(now.pose, following.left_m, dt_s) > self._settings.stuck_s:
            return self._no_progress(now, AROUND if avoids else "")
        self.state = NavigationState.AVOIDING if avoids else NavigationState.DRIVING
        self.reason = now.wheels.reason if now.wheels.is_held else reason
        drive.waited_s = 0.0
        return Navigation(setpoint, self.state, self.reason, following.left_m, following.offset_m)

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
        """Add the way since the last pose to that without a pose in the map; begin again after a reset."""
        moved_m = 0.0 if drive.last_xy is None else float(np.hypot(*(now.pose[:2] - drive.last_xy)))
        drive.last_xy = now.pose[:2].copy()
        drive.unlocalised_m += moved_m
        if drive.resets != now.resets:
            drive.detour, drive.resets, drive.unlocalised_m = None, now.resets, math.inf
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
        if state is NavigationState.NOT_LOCALISED:
            drive.waited_s += dt_s
            if drive.waited_s > self._settings.unlocalised_s:
                return self._failed(f"{state} for {self._settings.unlocalised_s:g} s: {reason}")
        self.state, self.reason = state, reason
        setpoint = None if state is NavigationState.PAUSED else STAND
        return Navigation(setpoint, state, reason)

    def _around_obstacles(
        self, drive: Drive, now: Situation, following: Following
    ) -> tuple[Following, Setpoint | None, str]:
        """Return progress, motion and the reason why it is slower than wanted; no motion where no way is free."""
        around, wanted = self._surroundings(now), following.setpoint
        if around is None or drive.on_way.aligns:
            return following, wanted, ""
        # 1. Where the way is blocked another one is searched, and where that to a goal may be shorter by now.
        room_m = self._planner.room_m + (self._settings.clearance_m if drive.detour is None else 0.0)
        first_m = first_blocked_m(drive.ahead(now, LOOK_M), around.obstacles, room_m)
        is_blocked = first_m < math.inf or bool(now.wheels.held_by)
        if self._takes_other_way(drive, now, around, following, is_blocked=is_blocked):
            following = drive.step(now)
            wanted = following.setpoint
            first_m = first_blocked_m(drive.ahead(now, LOOK_M), around.obstacles, self._planner.room_m)
        # 2. Without a way around it, drive up to the obstacle and wait.
        left_m = first_m - self._stands_m
        if left_m <= 0 and wanted.velocity_mps > 0:
            return following, None, STANDS if now.moving is None else CROSSES
        braking_mps = math.sqrt(2 * BRAKE_SHARE * self._settings.pursuit.acceleration_mps2 * max(left_m, 0.0))
        return following, _slower(wanted, braking_mps), ""

    def _takes_other_way(
        self, drive: Drive, now: Situation, around: Surroundings, following: Following, *, is_blocked: bool
    ) -> bool:
        """True if the base takes another way from now on.

        A long way round, where the path or who moves was in the way, is taken once as much time was lost by waiting:
        nobody knows when the way is free again, and so at most twice the least time is lost (the ski rental problem).
        """
        detour, settings = drive.detour, self._settings
        is_to_goal = detour is not None and drive.paths[0].is_goal
        if is_to_goal and not is_blocked and self._can_go_straight(drive, now, around):
            drive.rejoin(now)
            return True
        is_due = is_blocked or (is_to_goal and following.left_m > DOCK_M)
        passed_ns = now.stamp_ns - drive.searched_ns
        if not is_due or not settings.corridor_m or passed_ns < (AGAIN_NS if is_blocked else SHORTER_NS):
            return False
        drive.searched_ns = now.stamp_ns
        barred = _kind(following.setpoint) if now.wheels.held_by else None
        found = self._search(drive, now, around, barred)
        drive.is_waiting = False
        if not isinstance(found, str) and is_blocked and drive.ways >= MOST_WAYS:
            found = f"{drive.ways} ways were tried"
        if isinstance(found, str):
            drive.no_way = found
            return False
        if is_blocked:
            free_s = self._planner.free_s(now.pose, drive.ahead(now, following.left_m), around)
            may_leave = detour is None or now.moving is not None
            worth_s = free_s + LOOK_M / settings.pursuit.velocity_mps + drive.blocked_s
            drive.is_waiting = may_leave and found.time_s > worth_s
            if drive.is_waiting:
                return False
            drive.ways += 1
        elif detour is not None:
            left_s = detour.time_s * following.left_m / max(detour.follower.path.length_m, SHORTEST_M)
            if found.time_s > BETTER * left_s:
                return False
        drive.take(found)
        return True

    def _surroundings(self, now: Situation) -> Surroundings | None:
        """Return what is about the base; what moves is an obstacle where the base would meet it."""
        if now.obstacles is None:
            return None
        obstacles = now.obstacles
        if now.moving is not None:
            meetings = now.moving.meetings(now.pose[:2], self._settings.pursuit.velocity_mps)
            obstacles = np.vstack([now.moving.others(obstacles), meetings])
        return Surroundings(obstacles, now.floor)

    def _search(self, drive: Drive, now: Situation, around: Surroundings, barred: Move | None) -> Detour | str:
        """Return a way to the goal, or to the path behind what is on it; why there is none otherwise."""
        settings, path = self._settings, drive.paths[0]
        place, corridor, heading_rad = (0, 0.0), None, math.nan
        if path.is_goal:
            goal = drive.in_odom(path.goal[None], now)[0]
        else:
            ahead = drive.follower.ahead(2 * LOOK_M)
            corridor = drive.in_odom(ahead.xy, now)
            obstacles = around.obstacles
            if barred is not None and around.floor is not None:  # by floor that is not seen
                obstacles = np.vstack([obstacles, around.floor.closed(now.pose, at_unknown=False)])
            k = _behind(corridor, obstacles, self._planner.room_m + settings.clearance_m)
            if k is None:
                return "the path is not free within sight"
            goal, place = corridor[k], (int(ahead.legs[k]), float(ahead.s[k]))
            leg = path.legs[min(place[0], len(path.legs) - 1)]
            heading_rad = leg.at(place[1])[2] + (math.pi if leg.backwards else 0.0)
            heading_rad -= float(now.T_frame_odom(drive.frame)[2])
        found = self._planner.way(now.pose, goal, around, corridor, heading_rad, barred)
        if isinstance(found, str):
            return found
        return Detour(Follower(found.path, settings, speed_mps=now.speed_mps), found.time_s, *place)

    def _can_go_straight(self, drive: Drive, now: Situation, around: Surroundings) -> bool:
        """True if the goal is ahead and nothing is on the straight way to it, with a cell to spare."""
        straight = goal_path(now.pose, drive.in_odom(drive.paths[0].goal[None], now)[0]).legs[0]
        aside_rad = abs(wrap_angle(float(straight.heading[0] - now.pose[2])))
        room_m = self._planner.room_m + self._settings.clearance_m + CELL_M
        obstacles = around.obstacles
        if around.floor is not None:
            obstacles = np.vstack([obstacles, around.floor.closed(now.pose, at_unknown=True)])
        return aside_rad < math.pi / 4 and math.isinf(first_blocked_m(straight.xy, obstacles, room_m))

    def _blocked(
        self, drive: Drive, reason: str, now: Situation, following: Following, dt_s: float, setpoint: Setpoint | None
    ) -> Navigation:
        """Wait for a free way; fail if for too long none leads to a goal. Paths and routes never give up."""
        drive.blocked_s += dt_s
        if drive.paths[0].is_goal and not drive.is_waiting and 0 < self._settings.give_up_s < drive.blocked_s:
            why = reason if setpoint is not None else drive.no_way or reason
            return self._failed(f"no way to the goal, {following.left_m:.1f} m are left: {why}")
        waiting = self._wait(drive, NavigationState.BLOCKED, f"{reason}: {WAITS}", dt_s)
        if setpoint is not None:
            waiting = waiting._replace(setpoint=setpoint)
        return waiting._replace(left_m=following.left_m, offset_m=following.offset_m)

    def _no_progress(self, now: Situation, does: str) -> Navigation:
        why = now.wheels.reason if now.wheels.is_held else does
        words = f"no progress for {self._settings.stuck_s:g} s", why, "look at the robot"
        return self._failed(": ".join(word for word in words if word))

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


def first_blocked_m(path: Array, obstacles: Array, room_m: float) -> float:
    """Return the way along a path (N, 2) to where it is nearer than a room to an obstacle (M, 2); inf without one.

    What the base is near to already, and drives away from, does not count.
    """
    near_m = distances(path, obstacles)
    is_blocked = near_m < room_m
    if is_blocked[0]:
        leaves = np.minimum.accumulate(np.append(True, np.diff(near_m) > -ROUNDING_M))
        is_blocked &= ~(leaves & np.minimum.accumulate(is_blocked))
    if not is_blocked.any():
        return math.inf
    k = int(np.argmax(is_blocked))
    return float(np.hypot(*np.diff(path[: k + 1], axis=0).T).sum())


def _behind(path: Array, obstacles: Array, room_m: float) -> int | None:
    """Return the first point of a path (N, 2) behind an obstacle about which REJOIN_M of it are free; None without."""
    ways = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(path, axis=0).T))])
    is_blocked = distances(path, obstacles) < room_m
    free_from = int(np.argmax(is_blocked))
    for k in range(free_from, len(path)):
        if is_blocked[k]:
            free_from = k + 1
        elif ways[k] - ways[min(free_from, k)] >= REJOIN_M or k == len(path) - 1:
            return k
    return None


def _kind(setpoint: Setpoint) -> Move:
    """Return the kind of a motion."""
    if setpoint.velocity_mps == 0.0:
        return Move.TURN
    return Move.AHEAD if setpoint.velocity_mps > 0.0 else Move.BACK


def _slower(wanted: Setpoint, speed_mps: float) -> Setpoint:
    """Return the motion on the same arc, limited to a speed ahead."""
    if wanted.velocity_mps <= speed_mps:
        return wanted
    share = speed_mps / wanted.velocity_mps
    return Setpoint(speed_mps, wanted.heading_rad, wanted.yaw_rate_radps * share)
