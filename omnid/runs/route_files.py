"""Requests to the navigation, and the files of routes that some of them need: no stage waits for a disk."""

from __future__ import annotations

import time
from dataclasses import replace
from typing import Final

from omnid.core.nanoseconds import NS_PER_S
from omnid.core.navigation.requests import NavigationCommand, RouteAction, RouteRequest, TaughtRoute, stops_motion
from omnid.engine.graph import Graph
from omnid.errors import OmnidError
from omnid.formats.route_file import RouteFolder
from omnid.messages import NavigationUpdate
from omnid.stages.routes import refusal_of_name
from omnid.transport.topics import MOST_OPEN

LONGEST_WAIT_S: Final = 5.0  # A robot that sets out later than this after the request surprises people.


class Requests:
    """The inlets of a graph for requests to the navigation, from any thread.

    Requests about routes pass through the thread of the files. All others, and those that stop a motion, overtake them.
    """

    def __init__(self, graph: Graph) -> None:
        self.direct, self.of_routes = graph.inlet(MOST_OPEN), graph.inlet(MOST_OPEN)

    def put(self, command: NavigationCommand) -> None:
        """Add a request."""
        is_of_route = isinstance(command.request, RouteRequest | TaughtRoute) and not stops_motion(command.request)
        (self.of_routes if is_of_route else self.direct).push(command)


class RouteFiles:
    """A stage that reads the route of a request to repeat it, and writes one that was taught."""

    def __init__(self, folder: RouteFolder) -> None:
        self._folder = folder

    def process(self, command: NavigationCommand) -> NavigationCommand:
        """Return a request with what the navigation has to know of its file."""
        request, name = command.request, getattr(command.request, "name", "")
        try:
            if isinstance(request, TaughtRoute):
                self._folder.write(request.route)
            elif isinstance(request, RouteRequest) and request.action is RouteAction.REPEAT:
                command = command._replace(request=replace(request, route=self._folder.read(name)))
            elif request == RouteRequest(RouteAction.TEACH, name) and self._folder.has(name):
                return command._replace(refusal=refusal_of_name(name))
        except OmnidError as error:
            return command._replace(refusal=str(error))
        if command.asked_ns and time.monotonic_ns() - command.asked_ns > LONGEST_WAIT_S * NS_PER_S:
            return command._replace(void="it waited too long for its file: check the disk, and ask again")
        return command


class TaughtRoutes:
    """A sink of the navigation that asks for a route that was taught to be written, once."""

    def __init__(self, requests: Requests) -> None:
        self._requests = requests
        self._asked: TaughtRoute | None = None

    def process(self, update: NavigationUpdate) -> None:
        """Take the route that is to be written, if there is one."""
        taught = update.taught
        if taught is not None and taught is not self._asked:
            self._asked = taught
            self._requests.put(NavigationCommand(taught, taught.route.created_s * NS_PER_S, id=taught.id))
