"""Teaching and repeating of routes, tied to the keyframes of the map of places."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from calib import se3
from calib.se2_arrays import planar
from omnid.core.navigation.path import DrivePath
from omnid.core.navigation.requests import RouteRequest, TaughtRoute
from omnid.core.navigation.route import KeyframePose, Route, RouteRecorder, repeated_paths
from omnid.core.navigation.situation import Situation, refusal_of_map
from omnid.errors import OmnidError
from omnid.messages import MapKeyframes
from omnid.tracking_state import MapState

Array = NDArray[np.float64]


def refusal_of_name(name: str) -> str:
    """Return why a route cannot be taught under a name that there is already."""
    return f"there is a route {name} already: choose another name, or replace it (`omnid route teach {name} --replace`)"


def refusal_while_teaching(name: str) -> str:
    """Return why nothing else can begin while a route is recorded."""
    return f"the route {name} is being taught: finish it, or drop it (`omnid route stop`)"


class Routes:
    """Record routes, and make paths of those that were read. Files are written and read by others.

    Routes are tied to the keyframes of the map of places, as the newest update has them.
    """

    def __init__(self, map_name: str, T_base_rect: Array, *, is_new: bool) -> None:
        """map_name: of the map's file; empty: the map is not saved, so no route can be tied to it.

        is_new: the map was empty before this run, and its frame is odom at the start.
        """
        self.map_name, self._is_new = map_name, is_new
        self._T_base_rect, self._T_rect_base = T_base_rect, se3.inverse(T_base_rect)
        self.keyframes = MapKeyframes({}, {})
        self._recorder: RouteRecorder | None = None
        self._resets = 0  # resets of odometry when the recording began
        self._finished: RouteRecorder | None = None  # recorder of the route that is to be written
        self.taught: TaughtRoute | None = None  # route that is to be written

    @property
    def teaching(self) -> str:
        """Name of the route that is recorded; empty without one."""
        return self._recorder.name if self._recorder else ""

    @property
    def taught_m(self) -> float:
        """Length of what is recorded so far."""
        return self._recorder.length_m if self._recorder else 0.0

    def teach(self, name: str, now: Situation, *, replace: bool = False) -> None:
        """Begin to record: where the robot is localised, or in a map that begins with this run. Raise OmnidError else.

        replace: a route of that name may exist, and gives way when the recording is finished.
        """
        self._require_map()
        if self._recorder is not None:
            raise OmnidError(refusal_while_teaching(self._recorder.name))
        if not replace and self.taught is not None and self.taught.route.name == name:
            raise OmnidError(refusal_of_name(name))
        refusal = refusal_of_map(now, math.inf)
        if refusal and not (self._is_new and now.resets == 0 and now.in_map is not None):
            raise OmnidError(refusal)
        self._recorder, self._resets = RouteRecorder(name), now.resets

    def record(self, now: Situation, tie: tuple[int, Array] | None) -> str:
        """Add the newest pose; return why the recording has ended, empty while it continues.

        tie: id of the newest keyframe, and its pose (3,) in the map; None: there is none yet.
        """
        if self._recorder is None or tie is None or now.in_map is None or now.in_map.state is MapState.LOST:
            return ""
        if now.resets != self._resets and now.in_map.state is not MapState.LOCALIZED:
            name, self._recorder = self._recorder.name, None
            return f"odometry has begun again, so that the way of the route {name} is not known: teach it again"
        try:
            self._recorder.add(now.map_pose(), now.speed_mps, *tie)
        except OmnidError as error:
            self._recorder = None
            return str(error)
        return ""

    def finish(self, created_s: int, id: int) -> None:
        """Have the recorded route written; id: of the request. Raise OmnidError without one, or where it has no end."""
        if self._recorder is None:
            raise OmnidError("no route is being taught: begin with `omnid route teach NAME`")
        if self.taught is not None:
            raise OmnidError(f"the route {self.taught.route.name} is being written: wait for its end")
        self._require_map()
        route = self._recorder.route(self._keyframe, self.keyframes.stamps_ns, created_s, self.map_name)
        self.taught, self._finished, self._recorder = TaughtRoute(route, id), self._recorder, None

    def written(self, refusal: str) -> None:
        """End the writing. Raise OmnidError with the refusal; the recording then continues, unless another began."""
        if refusal:
            self._recorder = self._recorder or self._finished
        self.taught, self._finished = None, None
        if refusal:
            raise OmnidError(refusal)

    def drop(self) -> bool:
        """Forget what is recorded; True if there was a recording."""
        dropped, self._recorder = self._recorder is not None, None
        return dropped

    def found(self, request: RouteRequest, refusal: str) -> Route:
        """Return the route of a request if it is one of this map. Raise OmnidError else, or with the refusal."""
        self._require_map()
        if refusal or request.route is None:
            raise OmnidError(refusal or f"the route {request.name} was not read")
        if not request.route.fits(self._keyframe):
            raise OmnidError(
                f"the route {request.name} was taught in the map {request.route.map_name} as it was then: start with "
                "that map (`omnid run --map`), or teach it again"
            )
        return request.route

    def paths(self, route: Route, request: RouteRequest, now: Situation) -> list[DrivePath]:
        """Return the paths of a repetition. Raise OmnidError where it is impossible."""
        return repeated_paths(
            route,
            self._keyframe,
            now.map_pose(),
            loops=request.loops,
            reverse=request.reverse,
            from_start=request.from_start,
        )

    def _keyframe(self, id: int) -> KeyframePose | None:
        """Return a keyframe of the map, None without one."""
        T_map_rect = self.keyframes.T_map_rect.get(id)
        if T_map_rect is None:
            return None
        return KeyframePose(self.keyframes.stamps_ns[id], planar(self._T_base_rect @ T_map_rect @ self._T_rect_base))

    def _require_map(self) -> None:
        if not self.map_name:
            raise OmnidError(
                "routes need a map that is saved: start the robot (`omnid run`, `omnid simulate`) with --map FILE.omap"
            )
