"""Routes and the map from the page: the same requests with the same answers as `omnid route` and `omnid map save`."""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from functools import partial
from typing import Final

from starlette.requests import Request

from omnid.core.navigation.requests import navigation_verb, route_request
from omnid.errors import OmnidError
from omnid.monitor.map_saving import save_map
from omnid.monitor.navigation import NavigationClient
from omnid.transport.bus_config import BusConfig
from omnid.web.wheel_commands import Answer

LONGEST_BODY: Final = 256  # bytes
BODY_S: Final = 5.0


class RouteRequests:
    """Sends requests, one at a time, each over a connection of its own."""

    def __init__(self, bus: BusConfig) -> None:
        """bus: settings of the connection, which has been checked."""
        self._bus = bus
        self._busy = asyncio.Lock()

    async def route(self, request: Request) -> Answer:
        """Pass on what a text of cmd/route says: "teach NAME", "finish", "repeat NAME", "stop"."""
        return await self._asked(request, "route")

    async def navigation(self, request: Request) -> Answer:
        """Pass on cancel, pause or resume."""
        return await self._asked(request, "navigation")

    async def save_map(self) -> Answer:
        """Ask the robot to save its map now."""
        return await self._alone(lambda: Answer(True, save_map(self._bus)))

    async def _asked(self, request: Request, kind: str) -> Answer:
        try:
            text = await _text_of(request)
            (route_request if kind == "route" else navigation_verb)(text)
        except OmnidError as error:
            return Answer(False, str(error))
        return await self._alone(partial(_answer, self._bus, kind, text))

    async def _alone(self, ask: Callable[[], Answer]) -> Answer:
        """Ask the robot in a thread, unless another request waits for its answer."""
        if self._busy.locked():
            return Answer(False, "another request has no answer yet")
        async with self._busy:
            try:
                return await asyncio.to_thread(ask)
            except OmnidError as error:
                return Answer(False, str(error))


def _answer(bus: BusConfig, kind: str, text: str) -> Answer:
    with NavigationClient(bus) as client:
        report = client.route(text) if kind == "route" else client.navigate(text)
    return Answer(True, f"{report.state}: {report.reason}".rstrip(": "))


async def _text_of(request: Request) -> str:
    """Return the body of a request. Raise OmnidError for one that is too long or does not come."""
    body = bytearray()
    try:
        async with asyncio.timeout(BODY_S):
            async for chunk in request.stream():
                body += chunk
                if len(body) > LONGEST_BODY:
                    raise OmnidError(f"a request of at most {LONGEST_BODY} bytes was expected")
    except TimeoutError:
        raise OmnidError("the request did not come") from None
    return body.decode("utf-8", "replace")
