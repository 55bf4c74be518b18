"""The addresses of the page about one robot, below that of the page itself."""

from __future__ import annotations

from collections.abc import Awaitable, Callable, Mapping

from starlette.requests import Request
from starlette.responses import JSONResponse, Response
from starlette.routing import BaseRoute, Route, WebSocketRoute

from omnid.client import Answer
from omnid.web.feed import RobotFeed
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
            WebSocketRoute("/live", self.feed.browsers.serve),
            command_route("/stop", lambda _: self.wheels.stop()),
            command_route("/arm", self._arm),
            command_route("/route", self._requests.route),
            command_route("/navigation", self._requests.navigation),
            command_route("/map", lambda _: self._requests.save_map()),
            command_route("/drive", self._stick.drive),
            command_route("/goal", self._requests.goal),
        ]

    def metrics(self, refused: Mapping[str, int]) -> str:
        """Return the metrics of the robot and of this server; refused: requests by reason."""
        counts = {"dropped": self.feed.inbox.dropped, "stops": self.wheels.stops, "arms": self._requests.arms}
        return metrics(self.feed.state, self.feed.browsers, refused, counts)

    async def _arm(self, request: Request) -> Answer:
        if self.wheels.is_stopping:
            return Answer(False, "a stop is not confirmed yet: arm after it")
        return await self._requests.arm(request, self.wheels.stop_ms)


def command_route(path: str, act: Callable[[Request], Awaitable[Answer]]) -> Route:
    """Return the address of a command, which comes by POST; the answer is JSON, with status 409 if it was not done."""

    async def respond(request: Request) -> Response:
        answer = await act(request)
        return JSONResponse(answer._asdict(), 200 if answer.done else 409)

    return Route(path, respond, methods=["POST"])
