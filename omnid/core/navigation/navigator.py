"""State machine of the navigation: from requests and poses to setpoints, with the reason for each stop.

Every end is a stop. Time is that of the poses. A drive in the frame map follows the corrections of the map. The base
drives straight to a goal, or along a path, while that is free; else by a way of the planner, to the goal or back to the
path. A moving object is an obstacle where the base would meet it. While no way is free, the base waits.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from calib.se2_arrays import composed, relative
from omnid.core.control.arming import PLANNER
from omnid.core.control.collision_monitor import CollisionSettings
from omnid.core.control.heading_controller import Setpoint, wrap_angle
from omnid.core.control.safety_rules import ASKED
from omnid.core.navigation.follower import BRAKE_SHARE, STANDSTILL, Follower, Following
from omnid.core.navigation.path import BEGIN, SHORTEST_M, DrivePath, PathPlace, goal_path, ways_m
from omnid.core.navigation.planner import Move, Planner, Way
from omnid.core.navigation.requests import NavigationFrame, NavigationState
from omnid.core.navigation.settings import NavigationSettings
from omnid.core.navigation.situation import UNKNOWN_M, Situation, refusal_of_map, require_drivable
from omnid.core.navigation.surroundings import Surroundings
from omnid.errors import OmnidError
from omnid.tracking_state import TrackingState

Array = NDArray[np.float64]

PROGRESS_M, PROGRESS_RAD = SHORTEST_M / 2, math.radians(5)  # A smaller motion is no progress.
STOPS: Final = 5  # A stop is sent at so many poses after the end of a drive, because one might be lost.
SEARCHED_AHEAD_M: Final = 2.0  # The way ahead is searched so far for obstacles, and twice that for a place behind.
REJOIN_M: Final = 0.3  # Free length of the path behind an obstacle, at which a detour ends.
# Time between two searches for a way while the present one is blocked, and for a shorter one while it is free.
AGAIN_NS, SHORTER_NS = 500_000_000, 2_000_000_000
DOCK_M: Final = 0.5  # The last way to a goal is driven straight on.
BETTER: Final = 0.8  # A way replaces one that is free only if it takes less than this share of its time.
LONGEST_STEP_S: Final = 1.0  # A longer time between two poses counts as this, because a gap is no wait.
NEARER_M: Final = 1.0  # After this progress the next block is a new one.

RESUME: Final = "`omnid goto --resume` (it arms, too)"  # the one command after a fault or a pause
NO_DRIVE: Final = "nothing is under way: give a goal, or repeat a route"
AROUND: Final = "it looks for a way around an obstacle"
WAITS: Final = "it goes on by itself when the way is free"
OBSTRUCTED: Final = "an obstacle is on the path"
CROSSES: Final = "a moving object crosses the path"


class Detour(NamedTuple):
    """A way of the planner, to the goal or back to the path."""

    follower: Follower  # in odom
    way: Way
    place: PathPlace  # on the path, to which it leads back


@dataclass(slots=True)
class Drive:
    """A drive from its start to its end."""

    frame: NavigationFrame
    paths: list[DrivePath]  # paths that are driven one after the other
    follower: Follower  # of the first of them
    resets: int
    stop_count: int  # ControllerState.stop_count at the start, or when a person resumed it
    heading_rad: float  # heading at the last progress
    xy: Array  # last position in odom
    detour: Detour | None = None  # None: it follows the path
    paused: str = ""  # reason of the pause; empty: it is not paused
    waited_s: float = 0.0  # for the pose in the map
    unlocalised_m: float = 0.0  # distance driven since the pose in the map was known
    localised_ns: int = -1  # stamp of the last known pose in the map
    nearest_m: float = math.inf  # length of the way that was left at the last progress
    stuck_s: float = 0.0  # time since the last progress
    least_m: float = math.inf  # least length of the way that was left, in steps of NEARER_M
    lost_s: float = 0.0  # time for which no way was free, since least_m fell
    tried_s: float = 0.0  # time on ways that were blocked again, since least_m fell
    way_s: float = 0.0  # time on the present way
    searched_ns: int = -AGAIN_NS  # stamp of the last search
    no_way: str = ""  # why the last search found no way
    move: Move | None = None  # kind of the newest motion that was wanted
    is_waiting: bool = False  # it waits, because the known way around takes longer than the time already waited

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
        xy, _ = self.on_way.ahead(way_m)
        return xy if self.detour is not None else self.in_odom(xy, now)

    def step(self, now: Situation, clearance_m: float) -> Following:
        """Return the motion along the detour, and after its end along the path; in odom."""
        motion = now.speed_mps, now.yaw_rate_radps, clearance_m
        if self.detour is not None:
            following = self.detour.follower.step(now.stamp_ns, now.pose, *motion)
            if following.missed_m is None and following.left_m >= SHORTEST_M:
                return following
            self.rejoin(now, self.detour.place)
        following = self.follower.step(now.stamp_ns, now.pose_in(self.frame), *motion)
        heading_rad = following.setpoint.heading_rad
        if heading_rad is None:
            return following
        turned_rad = float(now.T_frame_odom(self.frame)[2])
        setpoint = replace(following.setpoint, heading_rad=wrap_angle(heading_rad - turned_rad))
        return following._replace(setpoint=setpoint)

    def rejoin(self, now: Situation, place: PathPlace) -> None:
        """Follow the path again, from a place on it; to a goal straight on."""
        path = self.paths[0]
        if path.is_goal:
            path = goal_path(now.pose_in(self.frame), path.goal, path.final_heading_rad)
        self.detour, self.nearest_m = None, math.inf
        self.follower = Follower(path, self.follower.settings, place, now.speed_mps)

    def advance(self, now: Situation, left_m: float, dt_s: float) -> None:
        """Count the time since the last progress, a shorter way to go or a turn, and the time on this way."""
        turned_rad = abs(wrap_angle(float(now.pose[2]) - self.heading_rad))
        self.stuck_s, self.way_s = self.stuck_s + dt_s, self.way_s + dt_s
        if left_m < self.nearest_m - PROGRESS_M or turned_rad > PROGRESS_RAD:
            self.nearest_m, self.heading_rad, self.stuck_s = left_m, float(now.pose[2]), 0.0


class Navigation(NamedTuple):
    """The result of a step."""

    setpoint: Setpoint | None  # setpoint in odom; None: nothing is sent
    state: NavigationState
    reason: str
    left_m: float = math.nan  # way to the end of the path
    offset_m: float = math.nan  # distance of the base to the left of the path


def interruption(drive: Drive, now: Situation, settings: NavigationSettings) -> tuple[NavigationState, str] | None:
    """Return the state and the reason of a drive that may not go on now, None of one that may.

    The first rule that holds decides: an end is final, everything else is waited for.
    """
    # 1. A stop or fault that has disarmed the wheels, also if they were armed again since.
    wheels = now.wheels
    fault = wheels.disarmed_by if wheels.needs_request else ""
    if wheels.stop_count != drive.stop_count:
        fault = wheels.stopped_by
    if fault == ASKED:
        return NavigationState.CANCELLED, ASKED
    # 2. The pose.
    if drive.resets != now.resets and drive.frame is NavigationFrame.ODOM:
        return NavigationState.FAILED, "odometry has lost its map and begun again: ask again"
    if fault:
        drive.paused = f"disarmed: {fault}: see to it, then {RESUME}"
    if drive.paused:
        return NavigationState.PAUSED, drive.paused
    if now.state is TrackingState.LOST:
        return NavigationState.NOT_LOCALISED, "odometry is lost"
    if drive.frame is NavigationFrame.MAP and drive.unlocalised_m > settings.unlocalised_m:
        why = refusal_of_map(now, settings.map_sigma_m).partition(":")[0]
        return NavigationState.NOT_LOCALISED, why or "not localised"
    # 3. Other sources of commands.
    if wheels.source not in ("", PLANNER):
        return NavigationState.PAUSED, f"{wheels.source} drives: it goes on when that ends"
    return None


@dataclass(slots=True)
class Navigator:
    """Holds the present drive, if there is one."""

    settings: NavigationSettings
    collision: CollisionSettings = field(default_factory=CollisionSettings)  # the outline of the base
    drive: Drive | None = None
    state: NavigationState = NavigationState.IDLE
    reason: str = ""
    _stops: int = field(default=0, init=False)  # number of stops that are still to be sent
    _last_ns: int | None = field(default=None, init=False)
    _planner: Planner = field(init=False)

    def __post_init__(self) -> None:
        """Make the tables of the planner."""
        self._planner = Planner(self.settings, self.collision)

    @property
    def answer(self) -> Navigation:
        """The state and its reason without a new pose, and the stop that is to be sent."""
        stops = self._stops > 0 or (self.drive is not None and bool(self.drive.paused))
        return Navigation(STANDSTILL if stops else None, self.state, self.reason)

    def start(self, frame: NavigationFrame, paths: list[DrivePath], now: Situation) -> None:
        """Begin a drive, which replaces the one before."""
        follower, pose = Follower(paths[0], self.settings), now.pose
        self.drive = Drive(frame, paths, follower, now.resets, now.wheels.stop_count, float(pose[2]), pose[:2].copy())
        self._stops, self.state, self.reason = 0, NavigationState.DRIVING, ""

    def cancel(self, reason: str) -> None:
        """End the drive."""
        if self.drive is not None:
            self._end(NavigationState.CANCELLED, reason)

    def pause(self, reason: str) -> None:
        """Stop until `resume`. Raise OmnidError without a drive."""
        if self.drive is None:
            raise OmnidError(NO_DRIVE)
        self.drive.paused = self.drive.paused or reason
        self.state, self.reason = NavigationState.PAUSED, self.drive.paused

    def resume(self, now: Situation) -> None:
        """Continue a paused drive. Raise OmnidError without one, and where nothing can be driven now."""
        if self.drive is None:
            raise OmnidError(NO_DRIVE)
        require_drivable(now, NavigationFrame.ODOM, math.inf)
        self.drive.paused, self.drive.stop_count = "", now.wheels.stop_count
        self.drive.waited_s = self.drive.stuck_s = 0.0

    def step(self, now: Situation) -> Navigation:
        """Return the motion for a new pose, and the state with its reason."""
        dt_s = 0.0 if self._last_ns is None else min(max((now.stamp_ns - self._last_ns) * 1e-9, 0.0), LONGEST_STEP_S)
        self._last_ns, drive, settings = now.stamp_ns, self.drive, self.settings
        if drive is None:
            answer, self._stops = self.answer, max(self._stops - 1, 0)
            return answer
        # 1. Faults of wheels or pose, and other sources of commands.
        self._follow_map(drive, now)
        cause = interruption(drive, now, settings)
        if cause is not None:
            return self._wait(drive, *cause, dt_s)
        drive.resets = now.resets
        # 2. The way.
        following = drive.step(now, self._clearance_m(drive, now))
        if following.setpoint != STANDSTILL:
            drive.move = _kind(following.setpoint)
        if following.missed_m is not None:
            return self._finished(drive, following.missed_m)
        if abs(following.offset_m) > settings.corridor_m + self._planner.required_m:
            return self._end(
                NavigationState.FAILED,
                f"{abs(following.offset_m):.1f} m beside the path: drive back to it and ask again",
            )
        if following.left_m < drive.least_m - NEARER_M:
            drive.least_m, drive.lost_s, drive.tried_s = following.left_m, 0.0, 0.0
        # 3. Obstacles on the way, and a safety rule that stops the wheels because of an obstacle.
        following, obstacle = self._around_obstacles(drive, now, following)
        if obstacle or now.wheels.blocked_by:  # Stopped wheels still get the motion: the monitor releases them.
            return self._blocked(drive, obstacle, now.wheels.blocked_by, following, dt_s)
        # 4. The drive fails after too long a time without progress.
        avoids = drive.detour is not None
        drive.advance(now, following.left_m, dt_s)
        rule = now.wheels.stopping_rule
        if drive.stuck_s > settings.stuck_s:
            why = rule or (AROUND if avoids else "")
            parts = f"no progress for {settings.stuck_s:g} s", why, "look at the robot"
            return self._end(NavigationState.FAILED, ": ".join(part for part in parts if part))
        self.state = NavigationState.AVOIDING if avoids else NavigationState.DRIVING
        self.reason, drive.waited_s = rule, 0.0
        return Navigation(following.setpoint, self.state, self.reason, following.left_m, following.offset_m)

    def _follow_map(self, drive: Drive, now: Situation) -> None:
        """Add to the distance driven without a pose in the map; drop a detour after a reset of odometry."""
        drive.unlocalised_m += float(np.hypot(*(now.pose[:2] - drive.xy)))
        drive.xy = now.pose[:2].copy()
        if drive.resets != now.resets:
            drive.detour, drive.unlocalised_m = None, math.inf
        in_map = now.in_map
        if in_map is None or in_map.stamp_ns <= drive.localised_ns:  # no new pose in the map has come
            return
        if not refusal_of_map(now, self.settings.map_sigma_m):
            drive.unlocalised_m, drive.localised_ns = 0.0, in_map.stamp_ns
        elif in_map.sigma_m > UNKNOWN_M:
            drive.unlocalised_m = math.inf

    def _wait(self, drive: Drive, state: NavigationState, reason: str, dt_s: float) -> Navigation:
        """Stop and count the time, or end; fail where the pose in the map is missing for too long."""
        if state.is_end:
            return self._end(state, reason)
        if state is NavigationState.NOT_LOCALISED:
            drive.waited_s += dt_s
            if drive.waited_s > self.settings.unlocalised_s:
                return self._end(NavigationState.FAILED, f"{state} for {self.settings.unlocalised_s:g} s: {reason}")
        self.state, self.reason = state, reason
        return Navigation(None if state is NavigationState.PAUSED else STANDSTILL, state, reason)

    def _clearance_m(self, drive: Drive, now: Situation) -> float:
        """Return the distance [m] from the side of the base to the nearest obstacle on the next front_m."""
        if now.around is None:
            return math.inf
        near = drive.ahead(now, self.collision.front_m)
        return float(now.around.distance_at(near).min()) - self.collision.half_width_m

    def _around_obstacles(self, drive: Drive, now: Situation, following: Following) -> tuple[Following, str]:
        """Return progress with the motion on a free way; without one no motion, and what is in the way."""
        around = now.around
        if around is None or drive.on_way.aligns:
            return following, ""
        # 1. Search another way if this one is blocked, or if a shorter one to the goal may be free by now.
        pursuit, required_m = self.settings.pursuit, self._planner.required_m
        look = now.stamp_ns, pursuit.velocity_mps
        kept_m = required_m + (self.settings.clearance_m if drive.detour is None else 0.0)
        first_m = around.first_blocked_m(drive.ahead(now, SEARCHED_AHEAD_M), kept_m, *look)
        if self._begin_other_way(drive, now, around, following, is_closed=first_m < math.inf):
            following = drive.step(now, self._clearance_m(drive, now))
            first_m = around.first_blocked_m(drive.ahead(now, SEARCHED_AHEAD_M), required_m, *look)
        # 2. Without another way, wait: on a blocked detour at once, on the path in front of the obstacle.
        wanted = following.setpoint
        left_m = first_m - self.collision.front_m - 2 * self.collision.stop_m
        braking_mps = math.sqrt(2 * BRAKE_SHARE * pursuit.acceleration_mps2 * max(left_m, 0.0))
        has_reached = wanted.velocity_mps > 0 and braking_mps < pursuit.least_mps
        if has_reached or (first_m < math.inf and drive.detour is not None and drive.no_way):
            return following._replace(setpoint=STANDSTILL), CROSSES if around.has_moving else OBSTRUCTED
        share = min(1.0, braking_mps / wanted.velocity_mps) if wanted.velocity_mps > 0 else 1.0
        slower = Setpoint(share * wanted.velocity_mps, wanted.heading_rad, share * wanted.yaw_rate_radps)
        return following._replace(setpoint=slower), ""

    def _begin_other_way(
        self, drive: Drive, now: Situation, around: Surroundings, following: Following, *, is_closed: bool
    ) -> bool:
        """Begin another way if it is better, and return True. is_closed: an obstacle is or will be on the present one.

        A long way around an obstacle is chosen only after a wait as long as it takes longer: it is unknown when the
        present way is free again, and so at most twice the least time is lost (the ski rental problem).
        """
        detour, settings, path = drive.detour, self.settings, drive.paths[0]
        is_to_goal, is_blocked = detour is not None and path.is_goal, is_closed or bool(now.wheels.blocked_by)
        if is_to_goal and not is_blocked:
            goal = drive.in_odom(path.goal[None], now)[0]
            if self._planner.is_straight_free(now.pose, goal, around, now.stamp_ns):
                drive.rejoin(now, BEGIN)
                return True
        is_due = is_blocked or (is_to_goal and following.left_m > DOCK_M)
        passed_ns = now.stamp_ns - drive.searched_ns
        if not is_due or not settings.corridor_m or passed_ns < (AGAIN_NS if is_blocked else SHORTER_NS):
            return False
        drive.searched_ns, drive.is_waiting = now.stamp_ns, False
        if is_blocked and detour is not None:
            drive.tried_s, drive.way_s = drive.tried_s + drive.way_s, 0.0
        found = self._search(drive, now, around, drive.move if now.wheels.blocked_by else None)
        if not isinstance(found, str) and is_blocked and 0 < settings.give_up_s < drive.lost_s + drive.tried_s:
            found = f"ways of {drive.tried_s:.0f} s led no nearer"
        if isinstance(found, str):
            drive.no_way = found
            return False
        drive.no_way = ""
        if is_blocked:
            may_leave = is_closed and (detour is None or around.has_moving)
            worth_m = following.left_m + SEARCHED_AHEAD_M + settings.pursuit.velocity_mps * drive.lost_s
            drive.is_waiting = may_leave and found.way.length_m > worth_m
            if drive.is_waiting:
                return False
        elif detour is not None:
            left_s = detour.way.time_s * following.left_m / max(detour.way.path.length_m, SHORTEST_M)
            if found.way.time_s > BETTER * left_s:
                return False
        drive.detour, drive.nearest_m, drive.way_s = found, math.inf, 0.0
        return True

    def _search(self, drive: Drive, now: Situation, around: Surroundings, barred: Move | None) -> Detour | str:
        """Return a way to the goal, or to the path behind its obstacle; or the reason why there is none."""
        settings, path = self.settings, drive.paths[0]
        place, corridor, heading_rad = BEGIN, None, math.nan
        if path.is_goal:
            goal = drive.in_odom(path.goal[None], now)[0]
        else:
            xy, places = drive.follower.ahead(2 * SEARCHED_AHEAD_M)
            corridor = drive.in_odom(xy, now)
            distances = around.distance_m if barred is None else around.closed_distance_m
            distance_m = around.path_distance_m(corridor, now.stamp_ns, settings.pursuit.velocity_mps, distances)
            k = _behind(corridor, distance_m < self._planner.required_m + settings.clearance_m)
            if k is None:
                return "the path is not free within sight"
            goal, place = corridor[k], places[k]
            leg = path.legs[min(place.leg, len(path.legs) - 1)]
            heading_rad = leg.at(place.s_m)[2] + (math.pi if leg.backwards else 0.0)
            heading_rad -= float(now.T_frame_odom(drive.frame)[2])
        found = self._planner.way(
            now.pose, goal, around, now.stamp_ns, along=corridor, heading_rad=heading_rad, barred=barred
        )
        if isinstance(found, str):
            return found
        return Detour(Follower(found.path, settings, speed_mps=now.speed_mps), found, place)

    def _blocked(self, drive: Drive, obstacle: str, blocked_by: str, following: Following, dt_s: float) -> Navigation:
        """Wait for a free way; fail if for too long none leads to a goal. Paths and routes never give up.

        obstacle: on the way; empty: the collision monitor stops the base on a free one, for blocked_by.
        """
        drive.lost_s += dt_s
        lost_s = drive.lost_s + (drive.tried_s if drive.no_way else 0.0)
        if drive.paths[0].is_goal and not drive.is_waiting and 0 < self.settings.give_up_s < lost_s:
            why = (drive.no_way or obstacle) if obstacle else blocked_by
            return self._end(NavigationState.FAILED, f"no way to the goal, {following.left_m:.1f} m are left: {why}")
        self.state, self.reason = NavigationState.BLOCKED, f"{obstacle or blocked_by}: {WAITS}"
        return Navigation(following.setpoint, self.state, self.reason, following.left_m, following.offset_m)

    def _finished(self, drive: Drive, missed_m: float) -> Navigation:
        """Begin the next path, or end."""
        if len(drive.paths) > 1:
            del drive.paths[0]
            drive.follower, drive.nearest_m = Follower(drive.paths[0], self.settings), math.inf
            return Navigation(STANDSTILL, self.state, self.reason, drive.paths[0].length_m, 0.0)
        if missed_m > self.settings.goal_cm * 0.01:
            return self._end(NavigationState.FAILED, f"the goal is missed by {100 * missed_m:.1f} cm")
        return self._end(NavigationState.REACHED, "")._replace(left_m=0.0)

    def _end(self, state: NavigationState, reason: str) -> Navigation:
        """End the drive, with the first of some stops."""
        self.drive, self._stops = None, STOPS
        self.state, self.reason = state, reason
        return Navigation(STANDSTILL, state, reason)


def _behind(path: Array, is_blocked: NDArray[np.bool_]) -> int | None:
    """Return the first point of a path (N, 2) behind an obstacle about which REJOIN_M of it are free; None without."""
    ways = ways_m(path)
    free_from = int(np.argmax(is_blocked))
    for k in range(free_from, len(path)):
        if is_blocked[k]:
            free_from = k + 1
        elif ways[k] - ways[free_from] >= REJOIN_M or k == len(path) - 1:
            return k
    return None


def _kind(setpoint: Setpoint) -> Move:
    """Return the kind of a motion."""
    if setpoint.velocity_mps == 0.0:
        return Move.TURN
    return Move.AHEAD if setpoint.velocity_mps > 0.0 else Move.BACK
