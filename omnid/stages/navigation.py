"""Navigation stage: poses, places, obstacles and requests in; setpoints and the state of the navigation out."""

from __future__ import annotations

import math
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from calib import se3
from calib.se2_arrays import planar
from omnid.core.control.collision_monitor import CollisionSettings
from omnid.core.control.control_law import ControllerState
from omnid.core.frames import carried, in_outer_axes
from omnid.core.nanoseconds import NS_PER_S
from omnid.core.navigation.navigator import RESUME, Navigation, Navigator
from omnid.core.navigation.path import DrivePath, drive_path, goal_path
from omnid.core.navigation.requests import (
    GoalRequest,
    NavigationCommand,
    NavigationFrame,
    NavigationVerb,
    PathRequest,
    RouteAction,
    RouteRequest,
    TaughtRoute,
    begins_nothing,
)
from omnid.core.navigation.route import ENTRY_M, KeyframePose, Route, RouteRecorder, repeated_paths
from omnid.core.navigation.settings import NavigationSettings
from omnid.core.navigation.situation import MapPosition, Situation, refusal_of_map, require_drivable
from omnid.core.navigation.surroundings import Surroundings, near_ends
from omnid.errors import OmnidError
from omnid.messages import (
    MapKeyframes,
    NavigationPlan,
    NavigationUpdate,
    ObstacleScan,
    OdometryUpdate,
    PlaceUpdate,
    RequestAnswer,
)
from omnid.tracking_state import MapState

Array = NDArray[np.float64]
NavigationInput: TypeAlias = OdometryUpdate | PlaceUpdate | ObstacleScan | ControllerState | NavigationCommand

REPEAT_NS = NS_PER_S  # An unchanged state is published again after this time.
SCAN_NS = 2 * NS_PER_S  # Older scans are not used; the collision monitor then stops the base.


class NavigationStage:
    """Drive to goals, along paths and routes, and record routes. Its frames are those of the base, as on the bus.

    Routes are tied to the keyframes of the map of places, as the newest update has them. All routes are in memory, so
    that no request waits for a disk; another stage writes those that were taught.
    """

    def __init__(
        self,
        settings: NavigationSettings,
        collision: CollisionSettings,
        T_base_rig: Array,
        T_base_rect: Array,
        map_name: str,
        routes: dict[str, Route],
        *,
        is_new: bool,
    ) -> None:
        """collision: the outline of the base. T_base_rect: from the rectified frame, that of the map's keyframes.
        map_name: of the map's file; empty: the map is not saved, so no route can be tied to it. routes: by their names;
        a route that was taught is added. is_new: the map was empty before this run, and its frame is odom at the start.
        """
        self._settings, self._collision, self._T_base_rig = settings, collision, T_base_rig
        self._T_rig_base = se3.inverse(T_base_rig)
        self._T_base_rect, self._T_rect_base = T_base_rect, se3.inverse(T_base_rect)
        self.map_name, self._routes, self._is_new = map_name, routes, is_new
        self._wheels = ControllerState()
        self._navigator = Navigator(settings, collision)
        self._task, self._command_ns = "", 0  # words and stamp of the request for the drive, kept after its end
        self._now: Situation | None = None
        self._in_map: MapPosition | None = None
        self.keyframes = MapKeyframes({}, {})
        self._newest_keyframe: tuple[int, Array] | None = None  # its id and pose (3,) in the map
        self._reset_ns = -1  # stamp of the pose at which odometry began again
        self._scan: ObstacleScan | None = None
        self._around: Surroundings | None = None  # from the newest scan that was used
        self._recorder: RouteRecorder | None = None  # of the route that is taught
        self._taught: TaughtRoute | None = None  # the last route that was taught
        self._taught_resets = 0  # resets of odometry when the recording began
        self._seq = 0
        self._answer: RequestAnswer | None = None  # to the newest request
        self._plan: NavigationPlan | None = None  # plan that is not yet part of a message
        self._published: tuple[object, ...] = ()  # the newest published state
        self._published_ns = -REPEAT_NS

    def process(self, message: NavigationInput) -> NavigationUpdate | None:
        """Return the motion at a pose, or the answer to a request; None where nothing is to be sent or has changed."""
        match message:
            case OdometryUpdate():
                return self._at_pose(message)
            case NavigationCommand():
                return self._request(message)
            case PlaceUpdate():
                self._place(message)
            case ObstacleScan():
                self._scan = message
            case ControllerState():
                self._wheels = message
        return None

    def _at_pose(self, odometry: OdometryUpdate) -> NavigationUpdate | None:
        # 1. After a reset forget the pose in the map and the surroundings: they are of another odom.
        self._seq = odometry.seq
        if self._now is not None and self._now.resets != odometry.reset_counter:
            self._in_map, self._reset_ns = None, odometry.stamp_ns
            self._scan = self._around = None
        # 2. Collect the pose of the base and its surroundings.
        T_odom_base, _, velocity, _ = odometry.of_base(self._T_base_rig)
        self._now = now = Situation(
            odometry.stamp_ns,
            planar(T_odom_base),
            float(velocity[0]),
            float(velocity[5]),
            odometry.state,
            odometry.reset_counter,
            self._wheels,
            self._in_map,
            self._surroundings(odometry.stamp_ns),
        )
        # 3. Add the pose to a route that is being taught, and steer.
        self._record(now)
        return self._update(self._navigator.step(now))

    def _surroundings(self, now_ns: int) -> Surroundings | None:
        """Return the surroundings by the newest scan; None if it is too old, or without a drive."""
        scan, before = self._scan, self._around
        is_recent = scan is not None and 0 <= now_ns - scan.stamp_ns <= SCAN_NS
        if self._navigator.drive is None or scan is None or scan.grid is None or not is_recent:
            return None
        if before is None or before.stamp_ns != scan.stamp_ns:
            pose = planar(scan.T_odom_base)
            ends = near_ends(pose, scan.ranges_m, scan.free_m, self._collision)
            self._around = Surroundings(scan.grid, scan.moving, scan.stamp_ns, pose, before, ends)
        return self._around

    def _place(self, update: PlaceUpdate) -> None:
        if update.stamp_ns < self._reset_ns:
            return
        T_map_base, covariance = carried(update.T_map_rig, update.covariance, self._T_base_rig)
        T_map_odom, _ = carried(update.T_map_odom, update.covariance, self._T_base_rig)
        in_plane = in_outer_axes(T_map_base, covariance)[:2, :2]
        sigma_m = math.sqrt(max(float(np.linalg.eigvalsh(in_plane)[-1]), 0.0))  # NaN stays NaN in this order
        self._in_map = MapPosition(planar(T_map_odom), update.state, sigma_m, update.stamp_ns)
        T_map_keyframe = T_map_base @ self._T_base_rig @ se3.inverse(update.T_keyframe_rig) @ self._T_rig_base
        self._newest_keyframe = update.keyframe, planar(T_map_keyframe)
        self.keyframes = update.keyframes or self.keyframes

    def _request(self, command: NavigationCommand) -> NavigationUpdate | None:
        """Execute a request and return the new state with the answer; a finished route is answered by its writer."""
        word, taught, refusal = _word(command), self._taught, ""
        try:
            self._execute(command)
        except OmnidError as error:
            refusal = str(error)
        if self._taught is taught:
            self._answer = RequestAnswer(command.id, word, refusal)
        self._published = ()  # so that the state is sent in any case
        return self._update(self._navigator.answer)

    def _execute(self, command: NavigationCommand) -> None:
        """Execute a request. Raise OmnidError with the reason to refuse it."""
        request, navigator = command.request, self._navigator
        if not begins_nothing(request) and command.stop_count < self._wheels.stop_count:
            raise OmnidError("a stop or a fault has come since: ask again")
        match request:
            case NavigationVerb.CANCEL:
                navigator.cancel("by a request")
            case NavigationVerb.PAUSE:
                navigator.pause(f"by a request: {RESUME}")
            case NavigationVerb.RESUME:
                navigator.resume(self._situation())
            case GoalRequest() | PathRequest():
                self._start(_word(command), request.frame, [self._path(request)], command)
            case RouteRequest(RouteAction.TEACH):
                self._teach(request)
            case RouteRequest(RouteAction.FINISH):
                self._finish(command)
            case RouteRequest(RouteAction.STOP):
                if self._recorder is None:
                    navigator.cancel("stopped by a request")
                self._recorder = None
            case RouteRequest(RouteAction.REPEAT):
                self._start(f"route {request.name}", NavigationFrame.MAP, self._repeated(request), command)

    def _start(self, task: str, frame: NavigationFrame, paths: list[DrivePath], command: NavigationCommand) -> None:
        self._navigator.start(frame, paths, self._situation())
        self._task, self._command_ns = task, command.stamp_ns
        xy = np.vstack([leg.xy for leg in paths[0].legs])
        self._plan = NavigationPlan(frame, xy, paths[0].final_heading_rad)

    def _path(self, request: GoalRequest | PathRequest) -> DrivePath:
        """Return the path of a request, from where the base is."""
        pose = self._pose_in(request.frame)
        first = request.xy[0] if isinstance(request, PathRequest) else (request.x_m, request.y_m)
        away_m = math.dist(pose[:2], first)
        if not away_m <= self._settings.reach_m:
            raise OmnidError(f"{away_m:.1f} m away: farther than navigation.reach_m = {self._settings.reach_m:g}")
        if isinstance(request, GoalRequest):
            return goal_path(pose, (request.x_m, request.y_m), request.heading_rad)
        if away_m > ENTRY_M:
            raise OmnidError(
                f"the path begins {away_m:.1f} m away from the robot, expected at most {ENTRY_M:g} m: "
                "drive to its start (`omnid goto`), or let it begin here"
            )
        return drive_path(np.vstack([pose[None, :2], request.xy]), request.heading_rad)

    def _repeated(self, request: RouteRequest) -> list[DrivePath]:
        """Return the paths of a repetition."""
        self._require_map()
        route, keyframes = self._routes.get(request.name), self._keyframe_poses()
        if route is None:
            raise OmnidError(f"there is no route {request.name}; routes: {', '.join(self._routes) or 'none'}")
        if not route.fits(keyframes):
            raise OmnidError(
                f"the route {request.name} was taught in the map {route.map_name} as it was then: start with "
                "that map (`omnid run --map`), or teach it again"
            )
        pose = self._pose_in(NavigationFrame.MAP)
        return repeated_paths(route, keyframes, pose, loops=request.loops, reverse=request.reverse)

    def _teach(self, request: RouteRequest) -> None:
        """Begin to record: where the robot is localised, or in a map that begins with this run."""
        if self._task.startswith("route") and self._navigator.drive is not None:
            raise OmnidError("a route is being repeated: stop it first")
        self._require_map()
        if request.name in self._routes and not request.replace:
            again = f"choose another name, or replace it (`omnid route teach {request.name} --replace`)"
            raise OmnidError(f"there is a route {request.name} already: {again}")
        now = self._situation()
        is_begun_here = self._is_new and now.resets == 0 and now.in_map is not None
        if not is_begun_here and (refusal := refusal_of_map(now, math.inf)):
            raise OmnidError(refusal)
        self._recorder, self._taught_resets = RouteRecorder(request.name), now.resets

    def _record(self, now: Situation) -> None:
        """Add the newest pose to the route that is being taught, where it is known in the map."""
        recorder, keyframe, in_map = self._recorder, self._newest_keyframe, now.in_map
        if recorder is None or keyframe is None or in_map is None or in_map.state is MapState.LOST:
            return
        try:
            if now.resets != self._taught_resets and in_map.state is not MapState.LOCALIZED:
                raise OmnidError(
                    f"odometry has begun again, so that the way of the route {recorder.name} is not known: teach it "
                    "again"
                )
            self._taught_resets = now.resets  # A place was recognised since the reset, so the map has its gap.
            recorder.add(now.pose_in(NavigationFrame.MAP), now.speed_mps, *keyframe)
        except OmnidError as error:
            self._recorder = None
            self._answer = RequestAnswer(0, "teach", str(error))

    def _finish(self, command: NavigationCommand) -> None:
        """Pass the recorded route on to be written; without one the last route again, whose disk may have been full."""
        if self._recorder is not None:
            created_s = command.arrival_ns // NS_PER_S
            route = self._recorder.route(self._keyframe_poses(), created_s, self.map_name)
            self._recorder, self._routes[route.name] = None, route
        elif self._taught is not None:
            route = self._taught.route
        else:
            raise OmnidError("no route is being taught: begin with `omnid route teach NAME`")
        self._taught = TaughtRoute(route, command.id)

    def _keyframe_poses(self) -> dict[int, KeyframePose]:
        """Return the keyframes of the map by id, with the poses of the base at them."""
        return {
            id: KeyframePose(self.keyframes.stamps_ns[id], planar(self._T_base_rect @ T_map_rect @ self._T_rect_base))
            for id, T_map_rect in self.keyframes.T_map_rect.items()
        }

    def _require_map(self) -> None:
        """Raise OmnidError where no route can be tied to a map, or one is being taught."""
        if not self.map_name:
            raise OmnidError(
                "routes need a map that is saved: start the robot (`omnid run`, `omnid simulate`) with --map FILE.omap"
            )
        if self._recorder is not None:
            raise OmnidError(
                f"the route {self._recorder.name} is being taught: finish it, or drop it (`omnid route stop`)"
            )

    def _pose_in(self, frame: NavigationFrame) -> Array:
        """Return the pose (3,) of the base in a frame. Raise OmnidError where nothing can be driven in it."""
        situation = self._situation()
        require_drivable(situation, frame, self._settings.map_sigma_m)
        return situation.pose_in(frame)

    def _situation(self) -> Situation:
        if self._now is None:
            raise OmnidError("there is no pose yet: wait until the robot is ready (`omnid listen`)")
        return self._now._replace(in_map=self._in_map, wheels=self._wheels)

    def _update(self, now: Navigation) -> NavigationUpdate | None:
        drive, answer, recorder = self._navigator.drive, self._answer, self._recorder
        stamp_ns = 0 if self._now is None else self._now.stamp_ns
        plan, self._plan = self._plan, None
        teaching = recorder.name if recorder else ""
        state = (now.state, now.reason, self._task, teaching, self._taught, answer)
        same = state == self._published and now.setpoint is None and plan is None
        if same and stamp_ns - self._published_ns < REPEAT_NS:
            return None
        self._published, self._published_ns = state, stamp_ns
        return NavigationUpdate(
            self._seq,
            stamp_ns,
            now.setpoint,
            now.state,
            now.reason,
            self._task,
            self._command_ns,
            now.left_m,
            now.offset_m,
            len(drive.paths) if drive else 0,
            teaching,
            recorder.length_m if recorder else 0.0,
            self._taught,
            answer,
            plan,
        )


def _word(command: NavigationCommand) -> str:
    """Return the request of a command in a word."""
    match command.request:
        case GoalRequest():
            return "goal"
        case PathRequest():
            return "path"
        case RouteRequest(action, name):
            return f"{action} {name}".strip()
        case verb:
            return str(verb)
