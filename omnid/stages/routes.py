"""Teaching and repeating of routes: recorder, files, and the map that routes are tied to."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from omnid.core.navigation.path import DrivePath
from omnid.core.navigation.requests import RouteRequest
from omnid.core.navigation.route import KeyframePose, Route, RouteRecorder, repeated_paths
from omnid.core.navigation.situation import Situation, refusal_of_map
from omnid.errors import OmnidError
from omnid.tracking_state import MapState

Array = NDArray[np.float64]


class RouteStore(Protocol):
    """Files of routes; reading and writing raise OmnidError where they cannot."""

    def has(self, name: str) -> bool:
        """True if there is a route of that name, readable or not."""

    def read(self, name: str) -> Route:
        """Return a route."""

    def write(self, route: Route) -> None:
        """Write a route."""


class RouteMap(Protocol):
    """The map of places that routes are tied to; called in the thread of the navigation."""

    name: str  # of its file; empty: it is not saved, so that no route can be tied to it
    is_new: bool  # it was empty before this run, and lies where odom began

    def keyframe(self, id: int) -> KeyframePose | None:
        """Return a keyframe as the map knows it now."""

    def noted(self) -> Mapping[int, int]:
        """Return stamps of some of its keyframes, by which it is told from other maps."""

    def save(self) -> None:
        """Have the map written as it is now, soon."""


class KeyframeTie:
    """The newest keyframe, and the pose of the base in the map as that says."""

    def __init__(self, id: int, pose: Array) -> None:
        """pose: (3,) of the keyframe in the map."""
        self.id, self.pose = id, pose


class Routes:
    """Record and read routes."""

    def __init__(self, store: RouteStore, places: RouteMap | None) -> None:
        self._store, self._places = store, places
        self._recorder: RouteRecorder | None = None
        self._resets = 0  # of odometry when the recording began

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
        places = self._map()
        if self._recorder is not None:
            raise OmnidError(f"the route {self._recorder.name} is being taught: finish or stop it first")
        if not replace and self._store.has(name):
            raise OmnidError(f"there is a route {name} already: choose another name, or replace it (`omnid route teach "
                             f"{name} --replace`)")
        refusal = refusal_of_map(now, math.inf)
        if refusal and not (places.is_new and now.resets == 0 and now.in_map is not None):
            raise OmnidError(refusal)
        self._recorder, self._resets = RouteRecorder(name), now.resets

    def record(self, now: Situation, tie: KeyframeTie | None) -> str:
        """Add the newest pose; return why the recording has ended, empty while it goes on."""
        if self._recorder is None or tie is None or now.in_map is None or now.in_map.state is MapState.LOST:
            return ""
        if now.resets != self._resets and now.in_map.state is not MapState.LOCALIZED:
            name, self._recorder = self._recorder.name, None
            return f"odometry has begun again, so that the way of the route {name} is not known: teach it again"
        try:
            self._recorder.add(now.map_pose(), now.speed_mps, tie.id, tie.pose)
        except OmnidError as error:
            self._recorder = None
            return str(error)
        return ""

    def finish(self, created_s: int) -> Route:
        """Write the recorded route, and the map. Raise OmnidError where that is impossible; then it is still there."""
        if self._recorder is None:
            raise OmnidError('no route is being taught: begin with "teach NAME"')
        places = self._map()
        route = self._recorder.route(places.keyframe, places.noted(), created_s, places.name)
        self._store.write(route)
        places.save()
        self._recorder = None
        return route

    def drop(self) -> bool:
        """Forget what is recorded; True if there was a recording."""
        dropped, self._recorder = self._recorder is not None, None
        return dropped

    def read(self, name: str) -> Route:
        """Return a route of this map. Raise OmnidError where there is none of that name."""
        places = self._map()
        route = self._store.read(name)
        if not route.fits(places.keyframe):
            raise OmnidError(f"the route {route.name} was taught in another map ({route.map_name}) than "
                             f"{places.name}: start with that map (`omnid run --map`), or teach it again")
        return route

    def paths(self, route: Route, request: RouteRequest, now: Situation) -> list[DrivePath]:
        """Return the paths of a repetition. Raise OmnidError where it is impossible."""
        places = self._map()
        return repeated_paths(route, places.keyframe, now.map_pose(), loops=request.loops, reverse=request.reverse,
                              from_start=request.from_start)

    def _map(self) -> RouteMap:
        if self._places is None or not self._places.name:
            raise OmnidError("routes need a map that is saved: start with `omnid run --map FILE.omap`")
        return self._places
