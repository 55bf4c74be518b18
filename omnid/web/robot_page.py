"""The addresses of the page about one robot, below that of the page itself."""

from __future__ import annotations

from starlette.requests import Request
from starlette.responses import JSONResponse, Response
from starlette.routing import BaseRoute, Route, WebSocketRoute
from starlette.websockets import WebSocket

from omnid.client import Answer
from omnid.web.feed import RobotFeed
from omnid.web.guard import Guard
from omnid.web.metrics import metrics
from omnid.web.robot_requests import RobotRequests
from omnid.web.stick import StickCommands
from omnid.web.wheel_commands import WheelCommands


class RobotPage:
    """The answers about one robot."""

    def __init__(self, feed: RobotFeed) -> None:
        self.feed, self.wheels, self._requests = feed, WheelCommands(feed), RobotRequests(feed)
        self._stick = StickCommands(feed, self.wheels)

    def routes(self) -> list[BaseRoute]:
        """Return the addresses."""
        return [
            WebSocketRoute("/live", self._live),
            Route("/stop", self._stop, methods=["POST"]),
            Route("/arm", self._arm, methods=["POST"]),
            Route("/route", self._route, methods=["POST"]),
            Route("/navigation", self._navigation, methods=["POST"]),
            Route("/map", self._map, methods=["POST"]),
            Route("/drive", self._drive, methods=["POST"]),
            Route("/goal", self._goal, methods=["POST"]),
        ]

    def metrics(self, guard: Guard) -> str:
        """Return the metrics of the robot and of this server."""
        counts = {"dropped": self.feed.inbox.dropped, "stops": self.wheels.stops, "arms": self._requests.arms}
        return metrics(self.feed.state, self.feed.browsers, guard.refused, counts)

    async def _live(self, websocket: WebSocket) -> None:
        await self.feed.browsers.serve(websocket)

    async def _stop(self, _: Request) -> Response:
        return answered(await self.wheels.stop())

    async def _arm(self, _: Request) -> Response:
        if self.wheels.is_stopping:
            return answered(Answer(False, "a stop is not confirmed yet: arm after it"))
        return answered(await self._requests.arm())

    async def _route(self, request: Request) -> Response:
        return answered(await self._requests.route(request))

    async def _navigation(self, request: Request) -> Response:
        return answered(await self._requests.navigation(request))

    async def _drive(self, request: Request) -> Response:
        return answered(await self._stick.drive(request))

    async def _goal(self, request: Request) -> Response:
        return answered(await self._requests.goal(request))

    async def _map(self, _: Request) -> Response:
        return answered(await self._requests.save_map())


def answered(answer: Answer) -> Response:
    """Return the answer to a command as JSON."""
    return JSONResponse(answer._asdict(), 200 if answer.done else 409)
