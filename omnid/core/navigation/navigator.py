"""State machine of the navigation: from requests and poses to setpoints, with the reason for each halt.

Every end is a stop. Time is that of the poses. A drive in the frame map follows the corrections of the map.
"""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass, field, replace
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from calib.se2_arrays import composed, relative
from omnid.core.control.collision_monitor import UNKNOWN, CollisionSettings
from omnid.core.control.command_sources import PLANNER
from omnid.core.control.heading_controller import Setpoint, wrap_angle
from omnid.core.control.safety_rules import ASKED
from omnid.core.navigation.follower import BRAKE_SHARE, STAND, Follower, Following
from omnid.core.navigation.forecast import Pace, yielding
from omnid.core.navigation.path import SHORTEST_M, DrivePath, drive_path, goal_path
from omnid.core.navigation.planner import BACK_MPS, Planner, distances
from omnid.core.navigation.requests import NavigationFrame
from omnid.core.navigation.settings import NavigationSettings
from omnid.core.navigation.situation import NOWHERE, UNKNOWN_M, Situation, refusal_of_map, refusal_to_drive
from omnid.navigation_state import NavigationState
from omnid.tracking_state import MapState, TrackingState

Array = NDArray[np.float64]

PROGRESS_M, PROGRESS_RAD = 0.05, math.radians(5)  # A smaller motion is no progress; by trial on development seeds.
STOPS: Final = 5  # A stop is sent at so many poses after the end of a drive, because one might be lost.
LOOK_M: Final = 2.0  # Length of the way ahead in which obstacles are searched; a free place behind them in twice that.
REJOIN_M: Final = 0.3  # Free length of the path behind an obstacle, at which a detour ends.
AGAIN_NS: Final = 500_000_000  # between two searches
MOST_WAYS: Final = 12  # Most ways that are tried without coming NEARER_M nearer to the end.
LONGEST_STEP_S: Final = 1.0  # A longer time between two poses counts as this, because a gap is no wait.
# A person's two steps: after this progress the next block is a new one; least way back to a wider place; length of the
# way past the block that must be free before the base comes again.
NEARER_M: Final = 1.0
ROUNDING_M: Final = 0.005  # Least change of the room between two points of a way.
PASS_M: Final = 0.8  # room beside the outline in which a person passes
# Least wait after a way back; its spread, so that two robots that met move at different times.
REST_S, SPREAD_S = 3.0, 4
# It goes on after this time in any case, to look; after twice the time when it is blocked again; at most so long.
RETRY_S, LONGEST_RETRY_S = 10.0, 300.0

RESUME: Final = "`omnid goto --resume` (it arms, too)"  # the one command after a fault or a pause
AROUND: Final = "it looks for a way around an obstacle"
GIVES_WAY: Final = "it drives back to let others pass"
WAITS: Final = "it goes on by itself when the way is free"
STANDS: Final = "something stands on the path"
CROSSES: Final = "somebody or something crosses the path"


class Place(NamedTuple):
    """Where the base was, in odom, and where that is on its path."""

    xy: tuple[float, float]
    is_back: bool  # it came backwards
    leg: int
    s_m: float


class Detour(NamedTuple):
    """A way around something on the path."""

    follower: Follower  # in odom
    leg: int  # of the path, to which it leads back
    s_m: float  # on that leg
    length_m: float


@dataclass(slots=True)
class Retreat:
    """A blocked base drives back along the way that it came, lets others pass, and goes on (Place as in the trail)."""

    follower: Follower | None  # the way back, in odom; None: it waits
    ahead: Array  # (N, 2) in odom, from the end of the way back to the block and past it
    least_s: float  # it goes on after this time if the way ahead is free
    most_s: float  # and after this time in any case, to look
    rested_s: float = 0.0


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
    nearest_m: float = math.inf  # length of the way that was left at the last progress
    heading_rad: float = 0.0  # heading at the last progress
    stuck_s: float = 0.0  # time since the last progress
    blocked_s: float = 0.0  # time for which no way was found since the base has come nearer to the end
    last_xy: Array | None = None  # last position in odom
    detour: Detour | None = None  # None: it follows the path
    retreat: Retreat | None = None  # None unless the base gives way now
    least_m: float = math.inf  # least length of the way that was left, in steps of NEARER_M
    gave_way: int = 0  # number of times that the base gave way since then
    ways: int = 0  # number of ways that were found since then, each of which was blocked again
    around_unknown: bool = False  # floor that was not seen has stopped the base: it is an obstacle until it is passed
    searched_ns: int = -AGAIN_NS  # stamp of the last search
    no_way: str = ""  # why it was in vain
    is_waiting: bool = False  # a way around is known that is longer than what it has waited is worth

    def in_odom(self, xy: Array, now: Situation) -> Array:
        """Return points (N, 2) of the path in odom."""
        T_odom_frame = relative(now.T_frame_odom(self.frame), np.zeros(3))
        path = composed(np.repeat(T_odom_frame[None], len(xy), 0), np.column_stack([xy, np.zeros(len(xy))]))
        return np.asarray(path[:, :2])

    def step(self, now: Situation) -> Following:
        """Return the motion along the path or the detour, in odom; at its end the path goes on."""
        motion = now.speed_mps, now.yaw_rate_radps, now.obstacle_m
        if self.detour is not None:
            following = self.detour.follower.step(now.stamp_ns, now.pose, *motion)
            if not following.done and following.left_m >= SHORTEST_M:
                return following
            self.rejoin(now, self.detour.leg, self.detour.s_m)
        following = self.follower.step(now.stamp_ns, now.pose_in(self.frame), *motion)
        heading_rad = following.setpoint.heading_rad
        if heading_rad is None:
            return following
        turned_rad = float(now.T_frame_odom(self.frame)[2])
        setpoint = replace(following.setpoint, heading_rad=wrap_angle(heading_rad - turned_rad))
        return following._replace(setpoint=setpoint)

    def rejoin(self, now: Situation, leg: int, s_m: float) -> None:
        """Follow the path from a place on it; to a goal straight on."""
        path, self.detour, self.nearest_m = self.paths[0], None, math.inf
        if path.is_goal:
            path, leg, s_m = goal_path(now.pose_in(self.frame), path.goal, path.final_heading_rad), 0, 0.0
        self.follower = Follower(path, self.follower.settings, leg, s_m, now.speed_mps)

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
        self._front_m, self._rear_m, self._stop_m = collision.front_m, collision.rear_m, collision.stop_m
        self._trail: deque[Place] = deque(maxlen=max(2, math.ceil(settings.give_way_m / SHORTEST_M) + 1))
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
        self._trail.clear()
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
        if drive.retreat is not None:
            return self._give_way(drive, drive.retreat, now, dt_s)
        # 4. The way.
        following = drive.step(now)
        if following.done:
            return self._finished(drive, following.missed_m)
        if (failed := self._taken_away(following)) is not None:
            return failed
        if following.left_m < drive.least_m - NEARER_M:
            drive.least_m, drive.gave_way, drive.ways, drive.blocked_s = following.left_m, 0, 0, 0.0
        # 5. Obstacles on it, and a safety rule that holds the wheels because of one.
        held_by = now.wheels.held_by
        drive.around_unknown |= held_by == UNKNOWN
        following, setpoint, reason = self._around_obstacles(drive, now, following)
        drive.around_unknown &= drive.detour is not None or bool(held_by)
        if setpoint is None or held_by:  # where it is held, the setpoint is still sent: the monitor lets go by itself
            return self._blocked(drive, reason if setpoint is None else held_by, now, following, dt_s, setpoint)
        # 6. Progress: where it is missing for too long, the base gives way or the drive fails.
        avoids = drive.detour is not None
        if self._is_stuck(drive, now, following, dt_s):
            if avoids and not drive.gave_way and self._begins_to_give_way(drive, now):
                return self._wait(drive, NavigationState.BLOCKED, AROUND, dt_s)
            return self._no_progress(now, AROUND if avoids else "")
        self.state = NavigationState.AVOIDING if avoids else NavigationState.DRIVING
        self.reason = now.wheels.reason if now.wheels.is_held else reason
        if not drive.stuck_s:  # a base that only creeps up to what blocks it waits on
            drive.waits.clear()
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
        """Add the pose to the trail, and its way to that without a pose in the map; begin again after a reset."""
        moved_m = 0.0 if drive.last_xy is None else float(np.hypot(*(now.pose[:2] - drive.last_xy)))
        drive.last_xy = now.pose[:2].copy()
        drive.unlocalised_m += moved_m
        if drive.resets != now.resets:
            self._trail.clear()
            drive.retreat = drive.detour = None
            drive.resets, drive.unlocalised_m = now.resets, math.inf
            if drive.frame is NavigationFrame.ODOM:
                self._end(NavigationState.FAILED, "odometry has lost its map and begun again: ask again")
        xy = float(now.pose[0]), float(now.pose[1])
        if drive.retreat is None and (not self._trail or math.dist(xy, self._trail[-1].xy) >= SHORTEST_M):
            self._trail.append(Place(xy, now.speed_mps < 0, *drive.follower.place))
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

    def _around_obstacles(
        self, drive: Drive, now: Situation, following: Following
    ) -> tuple[Following, Setpoint | None, str]:
        """Return progress, motion and the reason why it is slower than wanted; no motion where no way is free."""
        wanted, on_way = following.setpoint, drive.detour.follower if drive.detour else drive.follower
        if now.obstacles is None or on_way.aligns:
            return following, wanted, ""
        # 1. What moves: the speed at which it has passed; who comes to where the base would wait counts as standing.
        obstacles, share = now.obstacles, 1.0
        path = self._ahead(drive, now, LOOK_M)
        pursuit = self._settings.pursuit
        if now.moving is not None and wanted.velocity_mps > 0:
            standing_m = max(self._planner.room_m, self._front_m, self._rear_m)
            moving_m = max(self._planner.room_m + self._settings.clearance_m, self._front_m + self._stop_m)
            speed_mps = max(now.speed_mps, 0.0)
            pace = Pace(speed_mps, pursuit.velocity_mps, pursuit.acceleration_mps2, moving_m, standing_m)
            share, coming = yielding(self._ahead(drive, now, 2 * LOOK_M), on_way.leg_left_m, now.moving, pace)
            outlines = now.moving.outlines(coming, now.pose[:2], pursuit.velocity_mps)
            obstacles = np.vstack([now.moving.others(obstacles), outlines])
        # 2. The way is left where it is blocked, also by floor that was not seen, if there is a way around that.
        room_m = self._planner.room_m + (0.0 if drive.detour else self._settings.clearance_m)
        around = np.vstack([obstacles, now.unknown]) if drive.around_unknown else obstacles
        first_m = first_blocked_m(path, obstacles, room_m)
        is_held = drive.detour is not None and bool(now.wheels.held_by)
        is_blocked = is_held or first_m < math.inf or first_blocked_m(path, around, room_m) < math.inf
        if is_blocked and now.stamp_ns - drive.searched_ns >= AGAIN_NS:
            drive.searched_ns = now.stamp_ns
            found = self._search(drive, now, around)
            if found is None and drive.around_unknown and first_m < math.inf:
                found = self._search(drive, now, obstacles)
            # A long way round is taken once as much time was lost by waiting: nobody knows when the way is free again,
            # and so at most twice the least time is lost (the ski rental problem).
            worth_m = LOOK_M + pursuit.velocity_mps * drive.blocked_s
            drive.is_waiting = found is not None and found.length_m - following.left_m > worth_m
            if found is not None and not drive.is_waiting:
                drive.detour, drive.nearest_m, drive.ways = found, math.inf, drive.ways + 1
                following = drive.step(now)
                return following, following.setpoint, CROSSES if share < 1.0 else ""
        elif not is_blocked and drive.detour is not None and self._can_go_straight(drive, now, around):
            drive.rejoin(now, drive.detour.leg, drive.detour.s_m)
            following = drive.step(now)
            wanted = following.setpoint
        # 3. Without a way around it, drive up to the obstacle and wait.
        left_m = first_m - self._front_m - 2 * self._stop_m
        if left_m <= 0 and wanted.velocity_mps > 0:
            return following, None, STANDS
        if share == 0.0:
            return following, None, CROSSES
        if share < 1.0:
            return following, _slower(wanted, share * pursuit.velocity_mps), CROSSES
        return following, _slower(wanted, math.sqrt(2 * BRAKE_SHARE * pursuit.acceleration_mps2 * max(left_m, 0.0))), ""

    def _ahead(self, drive: Drive, now: Situation, way_m: float) -> Array:
        """Return the points (N, 2) of the way ahead, in odom."""
        if drive.detour is not None:
            return drive.detour.follower.ahead(way_m).xy
        return drive.in_odom(drive.follower.ahead(way_m).xy, now)

    def _search(self, drive: Drive, now: Situation, obstacles: Array) -> Detour | None:
        """Return a way around what is on the path; None without one."""
        settings, path = self._settings, drive.paths[0]
        if not settings.corridor_m:
            return None
        # 1. Where it leads: to the goal, or to the path behind the obstacle.
        if path.is_goal:
            goal, corridor, heading_rad = drive.in_odom(path.goal[None], now)[0], None, math.nan
            place = 0, 0.0
        else:
            ahead = drive.follower.ahead(2 * LOOK_M)
            corridor = drive.in_odom(ahead.xy, now)
            k = _behind(corridor, obstacles, self._planner.room_m + settings.clearance_m)
            if k is None:
                drive.no_way = "the path is not free within sight"
                return None
            goal, place = corridor[k], (int(ahead.legs[k]), float(ahead.s[k]))
            leg = path.legs[min(place[0], len(path.legs) - 1)]
            heading_rad = leg.at(place[1])[2] + (math.pi if leg.backwards else 0.0)
            heading_rad -= float(now.T_frame_odom(drive.frame)[2])
        # 2. The way.
        if drive.ways >= MOST_WAYS:
            drive.no_way = f"{drive.ways} ways were tried"
            return None
        found = self._planner.way(now.pose, goal, obstacles, corridor, heading_rad)
        if isinstance(found, str):
            drive.no_way = found
            return None
        return Detour(Follower(found, settings, speed_mps=now.speed_mps), *place, found.length_m)

    def _can_go_straight(self, drive: Drive, now: Situation, obstacles: Array) -> bool:
        """True if the goal is ahead and nothing is on the straight way to it."""
        path = drive.paths[0]
        if not path.is_goal:
            return False
        straight = goal_path(now.pose, drive.in_odom(path.goal[None], now)[0]).legs[0]
        aside_rad = abs(wrap_angle(float(straight.heading[0] - now.pose[2])))
        room_m = self._planner.room_m + self._settings.clearance_m
        return aside_rad < math.pi / 4 and math.isinf(first_blocked_m(straight.xy, obstacles, room_m))

    def _blocked(
        self, drive: Drive, reason: str, now: Situation, following: Following, dt_s: float, setpoint: Setpoint | None
    ) -> Navigation:
        """Wait for a free way, and give way where that takes too long; end where no way leads to a goal."""
        if self._gives_up(drive, dt_s):
            why = reason if setpoint is not None else drive.no_way or reason
            return self._failed(f"no way to the goal, {following.left_m:.1f} m are left: {why}")
        waiting = self._wait(drive, NavigationState.BLOCKED, f"{reason}: {WAITS}", dt_s)
        if drive.waits[NavigationState.BLOCKED] > self._settings.give_way_s:
            self._begins_to_give_way(drive, now)
        if setpoint is not None:
            waiting = waiting._replace(setpoint=setpoint)
        return waiting._replace(left_m=following.left_m, offset_m=following.offset_m)

    def _gives_up(self, drive: Drive, dt_s: float) -> bool:
        """True if for too long no way leads to a goal; paths and routes never give up."""
        drive.blocked_s += dt_s
        return drive.paths[0].is_goal and not drive.is_waiting and 0 < self._settings.give_up_s < drive.blocked_s

    def _begins_to_give_way(self, drive: Drive, now: Situation) -> bool:
        """Begin to drive back along the trail; False where there is no free way back, or it is switched off."""
        drive.waits[NavigationState.BLOCKED] = drive.stuck_s = 0.0
        if now.obstacles is None:
            return False
        room_m, places = self._planner.room_m, [*reversed(self._trail)]
        xy = np.array([now.pose[:2], *(place.xy for place in places)])
        ways = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(xy, axis=0).T))])
        # 1. As far as it is free now, and no farther than is wanted.
        free_m = first_blocked_m(xy, now.obstacles, room_m)
        last = int(np.searchsorted(ways, min(free_m - ROUNDING_M, self._settings.give_way_m), side="right"))
        # 2. Up to the next place where others can pass.
        is_wide = (distances(xy[:last], now.obstacles) > room_m + PASS_M) & (ways[:last] >= NEARER_M)
        last = int(np.argmax(is_wide)) + 1 if is_wide.any() else last
        if last < 2 or ways[last - 1] < self._front_m:
            return False
        # 3. There it waits, the longer the more often it has gone back.
        came_back = [places[0].is_back] * 2 + [place.is_back for place in places]
        path = drive_path(
            xy[:last], speeds=np.full(last, BACK_MPS), backwards=[not is_back for is_back in came_back[:last]]
        )
        drive.retreat = Retreat(
            Follower(path, self._settings),
            np.vstack([xy[:last][::-1], self._ahead(drive, now, NEARER_M)]),
            REST_S + now.stamp_ns // 1_000_000_000 % SPREAD_S,
            min(RETRY_S * 2.0**drive.gave_way, LONGEST_RETRY_S),
        )
        drive.gave_way, drive.nearest_m = drive.gave_way + 1, math.inf
        return True

    def _give_way(self, drive: Drive, retreat: Retreat, now: Situation, dt_s: float) -> Navigation:
        """Drive back, wait, and go on. All in odom."""
        if self._gives_up(drive, dt_s):
            return self._failed(f"no way to the goal, {drive.least_m:.1f} m are left: {drive.no_way or STANDS}")
        obstacles = NOWHERE if now.obstacles is None else now.obstacles
        # 1. Back, as far as it is seen to be free now.
        if retreat.follower is not None:
            following = retreat.follower.step(now.stamp_ns, now.pose, now.speed_mps, now.yaw_rate_radps)
            if (failed := self._taken_away(following)) is not None:
                return failed
            is_there = following.done or following.left_m < SHORTEST_M
            path = retreat.follower.ahead(NEARER_M).xy
            is_free = math.isinf(first_blocked_m(path, obstacles, self._planner.room_m))
            if not is_there and is_free and now.obstacles is not None and not now.wheels.held_by:
                if self._is_stuck(drive, now, following, dt_s):
                    return self._no_progress(now, GIVES_WAY)
                self.state, self.reason = NavigationState.AVOIDING, GIVES_WAY
                return Navigation(following.setpoint, self.state, self.reason, drive.least_m)
            retreat.follower = None
        # 2. Wait until the way is free, or it is time to look again.
        retreat.rested_s += dt_s
        nearest = int(np.argmin(np.hypot(*(retreat.ahead - now.pose[:2]).T)))
        room_m = self._planner.room_m + self._settings.clearance_m
        is_free = bool((distances(retreat.ahead[nearest:], obstacles) >= room_m).all())
        if retreat.rested_s < (retreat.least_s if is_free else retreat.most_s):
            return self._wait(drive, NavigationState.BLOCKED, f"it gives way: {WAITS}", dt_s)
        # 3. Go on from there.
        nearest_place = min(self._trail, key=lambda place: math.dist(place.xy, now.pose[:2]))
        drive.rejoin(now, nearest_place.leg, nearest_place.s_m)
        drive.retreat = None
        drive.waits.clear()
        return Navigation(STAND, self.state, self.reason, drive.least_m)

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

    def _taken_away(self, following: Following) -> Navigation | None:
        """Fail where the base is no longer near its path, for example because an operator has taken it away."""
        offset_m = abs(following.offset_m)
        if offset_m <= self._settings.corridor_m + self._planner.room_m:
            return None
        return self._failed(f"{offset_m:.1f} m beside the path: drive back to it and ask again")

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


def _slower(wanted: Setpoint, speed_mps: float) -> Setpoint:
    """Return the motion on the same arc, limited to a speed ahead."""
    if wanted.velocity_mps <= speed_mps:
        return wanted
    share = speed_mps / wanted.velocity_mps
    return Setpoint(speed_mps, wanted.heading_rad, wanted.yaw_rate_radps * share)
