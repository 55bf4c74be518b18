"""Files of routes for the navigation, whose stage waits for no disk."""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Callable
from dataclasses import replace
from typing import Final, NamedTuple

from omnid.core.navigation.requests import (
    NavigationCommand,
    NavigationRequest,
    RouteAction,
    RouteRequest,
    TaughtRoute,
    is_halt,
)
from omnid.engine.flow import nothing
from omnid.errors import OmnidError
from omnid.formats.route_file import RouteFolder
from omnid.messages import NavigationUpdate
from omnid.stages.routes import refusal_of_name
from omnid.transport.topics import MOST_OPEN

LONGEST_WAIT_S: Final = 5.0  # A robot that sets out later than this after the request surprises people.


class _Waiting(NamedTuple):
    command: NavigationCommand
    since_s: float  # of time.monotonic
    halts: int  # stops and faults that had come before it


class RouteFiles:
    """Reads routes before the requests to repeat them reach the stage, and writes those that were taught.

    A ticker calls it each PERIOD_S in a thread of its own.
    """

    PERIOD_S: Final = 0.05  # A person does not notice a delay of this size.

    def __init__(
        self,
        folder: RouteFolder,
        pass_on: Callable[[NavigationCommand], None],
        save_map: Callable[[], object] = nothing,
        *,
        halts: Callable[[], int] = lambda: 0,
    ) -> None:
        """pass_on: takes requests, from any thread. save_map: asks for the map to be written, which routes need. halts:
        returns how often a stop or a fault has made cmd/arm necessary; what waits from before begins nothing after it.
        """
        self._folder, self._pass_on, self.save_map, self._halts = folder, pass_on, save_map, halts
        self._waiting: deque[_Waiting] = deque()
        self._taught: TaughtRoute | None = None  # the newest one that is to be written
        self._written: TaughtRoute | None = None  # the one that was written last

    def put(self, command: NavigationCommand) -> None:
        """Take a request; it waits for its file, if it needs one, and for waiting requests before it; halts do not."""
        if is_halt(command.request) or not (self._waiting or _needs_file(command.request)):
            self._pass_on(command)
        elif len(self._waiting) >= MOST_OPEN:
            self._pass_on(command._replace(refusal="too many requests wait for files: ask again"))
        else:
            self._waiting.append(_Waiting(command, time.monotonic(), self._halts()))

    def process(self, update: NavigationUpdate) -> None:
        """Take the route that is to be written, if there is one."""
        self._taught = update.taught

    def __call__(self) -> None:
        """Write and read what waits."""
        if self._taught is not None and self._taught is not self._written:
            self._written = self._taught
            self._pass_on(self._stored(self._taught))
        while self._waiting:
            waiting = self._waiting[0]
            command = self._with_file(waiting.command)
            if waiting.halts != self._halts():
                command = command._replace(void="a stop or a fault has come since: ask again")
            elif time.monotonic() - waiting.since_s > LONGEST_WAIT_S:
                command = command._replace(void="it waited too long for its file: check the disk, and ask again")
            self._pass_on(command)
            self._waiting.popleft()  # now only: what comes meanwhile must not overtake it

    close = __call__

    def _stored(self, taught: TaughtRoute) -> NavigationCommand:
        """Write a route and have the map written; return what the stage has to know."""
        done = NavigationCommand(taught, taught.route.created_s * 1_000_000_000, id=taught.id)
        try:
            self._folder.write(taught.route)
        except OmnidError as error:
            return done._replace(refusal=str(error))
        self.save_map()
        return done

    def _with_file(self, command: NavigationCommand) -> NavigationCommand:
        """Return a request with what the stage has to know of its file."""
        request = command.request
        if not isinstance(request, RouteRequest):
            return command
        try:
            if request.action is RouteAction.REPEAT:
                return command._replace(request=replace(request, route=self._folder.read(request.name)))
            if request.action is RouteAction.TEACH and not request.replace and self._folder.has(request.name):
                return command._replace(refusal=refusal_of_name(request.name))
        except OmnidError as error:
            return command._replace(refusal=str(error))
        return command


def _needs_file(request: NavigationRequest) -> bool:
    return isinstance(request, RouteRequest) and request.action in (RouteAction.REPEAT, RouteAction.TEACH)
