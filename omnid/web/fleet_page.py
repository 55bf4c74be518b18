"""The page about all robots, and a page about each, which is opened at its first request and closed when not used."""

from __future__ import annotations

import asyncio
import time
from contextlib import suppress
from dataclasses import replace
from typing import Final

from starlette.requests import Request
from starlette.responses import FileResponse, JSONResponse, PlainTextResponse, Response
from starlette.routing import BaseRoute, Mount, Route, Router, WebSocketRoute

from omnid.errors import OmnidError
from omnid.transport.bus_config import BusConfig, checked
from omnid.web.feed import RobotFeed
from omnid.web.fleet_feed import FleetFeed
from omnid.web.guard import Guard, Receive, Scope, Send
from omnid.web.metrics import fleet_metrics
from omnid.web.robot_page import RobotPage, command_route
from omnid.web.site import STATIC

MOST_OPEN: Final = 8  # robots whose pages are open
UNUSED_S: Final = 60.0  # The connection to a robot ends after this time without a browser.
_CHECK_S: Final = 5.0


class _OpenRobot:
    """A robot whose page is open."""

    def __init__(self, bus: BusConfig) -> None:
        self.page = RobotPage(RobotFeed(bus))
        self.router = Router(routes=[Route("/", _index), *self.page.routes()])
        self.following = asyncio.create_task(self.page.feed.run())
        self.used_s = time.monotonic()

    @property
    def busy(self) -> bool:
        """True while a browser shows it or a stop is not confirmed."""
        return bool(len(self.page.feed.browsers)) or self.page.wheels.is_stopping


class FleetPage:
    """The answers about all robots."""

    def __init__(self, feed: FleetFeed, bus: BusConfig) -> None:
        """bus: settings of the connection, which has been checked."""
        self._feed, self._bus = feed, bus
        self._open: dict[str, _OpenRobot] = {}

    def routes(self) -> list[BaseRoute]:
        """Return the addresses."""
        return [
            WebSocketRoute("/live", self._feed.browsers.serve),
            command_route("/stop", lambda _: self._feed.stop_all()),
            Mount("/robot/{key}", app=self._robot),
        ]

    def metrics(self, guard: Guard) -> str:
        """Return the metrics of all robots and of this server."""
        counts = {"dropped": self._feed.inbox.dropped, "stops": self._feed.stops, "arms": 0}
        return fleet_metrics(self._feed.state.robots, self._feed.browsers, guard.refused, counts)

    async def run(self) -> None:
        """Follow all robots, and close the pages that are not used, until this task is cancelled."""
        try:
            await asyncio.gather(self._feed.run(), self._close_unused())
        finally:
            for key in list(self._open):
                await self._close(key)

    async def _robot(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Answer a request about one robot."""
        key = scope["path_params"]["key"]
        try:
            found = self._opened(key)
        except OmnidError as error:
            if scope["type"] == "websocket":
                await receive()
                await send({"type": "websocket.close", "code": 1013, "reason": str(error)[:100]})
                return
            refused: Response = JSONResponse({"done": False, "text": str(error)}, 409)
            if scope["method"] == "GET":
                refused = PlainTextResponse(f"omnid web: {error}\n", 404)
            await refused(scope, receive, send)
            return
        found.used_s = time.monotonic()
        await found.router(scope, receive, send)

    def _opened(self, key: str) -> _OpenRobot:
        """Return the page of a robot. Raise OmnidError where it cannot be opened."""
        if key not in self._open:
            name = self._feed.name_of(key)
            if name is None:
                raise OmnidError("this robot has not been seen since this server began: go back to all robots")
            bus = checked(replace(self._bus, robot=name))
            idle = sorted((page.used_s, other) for other, page in self._open.items() if not page.busy)
            if len(self._open) >= MOST_OPEN and not idle:
                raise OmnidError(f"the pages of {MOST_OPEN} robots are open: close one of them")
            if len(self._open) >= MOST_OPEN:
                self._open.pop(idle[0][1]).following.cancel()
            self._open[key] = _OpenRobot(bus)
        return self._open[key]

    async def _close_unused(self) -> None:
        while True:
            await asyncio.sleep(_CHECK_S)
            for key, page in list(self._open.items()):
                if page.busy:
                    page.used_s = time.monotonic()
                if page.following.done() or time.monotonic() > page.used_s + UNUSED_S:
                    await self._close(key)

    async def _close(self, key: str) -> None:
        """End the connection to a robot; raise what it failed with."""
        following = self._open.pop(key).following
        following.cancel()
        with suppress(asyncio.CancelledError):
            await following


async def _index(_: Request) -> Response:
    return FileResponse(STATIC / "index.html")
