"""Requests to the navigation, and the files of routes that some of them need: no stage waits for a disk."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable
from dataclasses import replace
from typing import Final

from omnid.core.nanoseconds import NS_PER_S
from omnid.core.navigation.requests import NavigationCommand, RouteAction, RouteRequest, TaughtRoute, stops_motion
from omnid.engine.graph import Graph, Stream
from omnid.errors import OmnidError
from omnid.formats.route_file import RouteFolder
from omnid.messages import NavigationUpdate, SaveMap
from omnid.transport.topics import MOST_OPEN, Answer

LONGEST_WAIT_S: Final = 5.0  # A robot that sets out later than this after the request surprises people.


class Requests:
    """The inlets of a graph for requests to the navigation, from any thread.

    Requests about routes pass through the thread of the files. All others, and those that stop a motion, overtake them.
    """

    def __init__(self, graph: Graph) -> None:
        self.direct, self.of_routes = graph.inlet(MOST_OPEN), graph.inlet(MOST_OPEN)

    def put(self, command: NavigationCommand) -> None:
        """Add a request."""
        is_of_route = isinstance(command.request, RouteRequest) and not stops_motion(command.request)
        (self.of_routes if is_of_route else self.direct).push(command)


class RouteFiles:
    """A stage that reads the route of a request to repeat it."""

    def __init__(self, folder: RouteFolder) -> None:
        self._folder = folder

    def process(self, command: NavigationCommand) -> NavigationCommand:
        """Return a request with what the navigation has to know of its file."""
        request, name = command.request, getattr(command.request, "name", "")
        try:
            if isinstance(request, RouteRequest) and request.action is RouteAction.REPEAT:
                command = command._replace(request=replace(request, route=self._folder.read(name)))
            elif request == RouteRequest(RouteAction.TEACH, name) and self._folder.has(name):
                again = f"choose another name, or replace it (`omnid route teach {name} --replace`)"
                return command._replace(refusal=f"there is a route {name} already: {again}")
        except OmnidError as error:
            return command._replace(refusal=str(error))
        if command.asked_ns and time.monotonic_ns() - command.asked_ns > LONGEST_WAIT_S * NS_PER_S:
            return command._replace(void="it waited too long for its file: check the disk, and ask again")
        return command


class TaughtRoutes:
    """A sink of the navigation that writes a route that was taught, has its map saved, and answers the request."""

    def __init__(
        self, folder: RouteFolder, to_save: Iterable[Stream[SaveMap]], answer: Callable[[int, Answer], object]
    ) -> None:
        """to_save: takes requests to save the map; empty: it is not saved. answer: takes the id of the request."""
        self._folder, self._to_save, self._answer = folder, to_save, answer
        self._written: TaughtRoute | None = None

    def process(self, update: NavigationUpdate) -> None:
        """Write the route of an update, if it is a new one."""
        taught = update.taught
        if taught is None or taught is self._written:
            return
        self._written = taught
        try:
            self._folder.write(taught.route)
        except OmnidError as error:
            self._answer(taught.id, Answer(False, f"{error}; finish it again once that is mended"))
            return
        for requests in self._to_save:
            requests.push(SaveMap(taught.id))
        self._answer(taught.id, Answer(True, "the route is written"))
