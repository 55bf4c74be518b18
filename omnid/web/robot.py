"""What the page asks of the robot: stop, arm, the stick, goals, routes, the map; answered as `omnid stop` ... are.

What lets the robot move (arm, goal, repeat, resume, the stick) carries the server's time in the newest state that the
page has shown. So a request that waited in a network moves nothing, and the browser's clock does not matter. What ends
a motion needs none. A browser that is closed sends nothing more, and the robot stops by its own deadline
(controller.deadlines.command_s).
"""

from __future__ import annotations

import asyncio
import math
import re
import time
from collections.abc import Awaitable, Callable
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from http import HTTPStatus
from typing import Final

from starlette.requests import Request
from starlette.responses import JSONResponse, Response
from starlette.routing import BaseRoute, Route

from omnid.client import ANSWER_S, Answer, Driver, Robot
from omnid.core.control.heading_controller import VelocityLimits
from omnid.core.navigation.requests import NavigationRequest, begins_nothing, navigation_verb, route_request
from omnid.errors import OmnidError
from omnid.monitor.robot_state import stop
from omnid.monitor.teleop import Stick, limits_of
from omnid.web.feed import OLDEST_S, RobotFeed, is_recent, server_ms

_NUMBER: Final = r"(-?\d{1,6}(?:\.\d{1,4})?)"
_GOAL: Final = re.compile(rf"{_NUMBER} {_NUMBER}(?: {_NUMBER})? (\d{{1,15}})")
_STAMPED: Final = re.compile(r"(.*?)(?: stamp=(\d{1,15}))?", re.DOTALL)
_STICK: Final = re.compile(r"(-?[01](?:\.\d{1,4})?) (-?[01](?:\.\d{1,4})?) (\d{1,15}) ([0-9a-z]{1,16})")


class RobotPage:
    """The answers about one robot."""

    def __init__(self, feed: RobotFeed) -> None:
        self.feed = feed
        self._stop_ms = 0  # the server's time at the newest request to stop
        self._stopping: asyncio.Task[Answer] | None = None
        self._again = False  # a stop was asked for since the newest one was sent
        self._busy: set[str] = set()  # kinds of the requests that wait for an answer, each in a thread
        self._limits: VelocityLimits | None = None  # those of the robot, once a page has taken the stick
        self._sending: asyncio.Future[None] | None = None  # the newest command of the stick
        self._page, self._held_until_s = "", -math.inf  # the page that drives
        # Sending may block while the robot does not read; no request holds up a stop.
        self._stop_thread, self._stick_thread = ThreadPoolExecutor(1), ThreadPoolExecutor(1)

    def routes(self) -> list[BaseRoute]:
        """Return the addresses."""
        commands: dict[str, Callable[[Request], Awaitable[Answer]]] = {
            "stop": lambda _: self.stop(),
            "arm": self.arm,
            "drive": self.drive,
            "goal": self.goal,
            "route": partial(self._ask_by_text, "route", route_request, Driver.route),
            "navigation": partial(self._ask_by_text, "navigation", navigation_verb, Driver.navigate),
            "map": lambda _: self._ask("map", Driver.save_map),
        }
        return [
            Route("/live", self.feed.live),
            Route("/image/{kind}", self.feed.image),
            *(Route(f"/{name}", partial(_respond, act), methods=["POST"]) for name, act in commands.items()),
        ]

    @property
    def is_stopping(self) -> bool:
        """True while a stop is sent and not confirmed."""
        return self._stopping is not None and not self._stopping.done()

    async def stop(self) -> Answer:
        """Stop the wheels, and wait until the robot confirms it, for at most 10 s after the newest request.

        A stop is repeated until the robot's status confirms it; any number of browsers may ask for it.
        """
        self._stop_ms = server_ms()
        self._again = True
        if self._stopping is None or self._stopping.done():
            self._stopping = asyncio.create_task(self._stop())
        return await asyncio.shield(self._stopping)  # a browser that goes does not end it

    async def _stop(self) -> Answer:
        not_confirmed = "the stop is NOT confirmed: use the emergency stop"
        while self._again:
            self._again = False
            try:
                stopping = partial(stop, self.feed.bus, connection=self.feed.robot)
                is_stopped = await asyncio.get_running_loop().run_in_executor(self._stop_thread, stopping)
                text = "the robot stops: its wheels stay stopped until it is armed" if is_stopped else not_confirmed
                answer = Answer(is_stopped, text)
            except OmnidError as error:
                answer = Answer(False, f"{not_confirmed}. {error}")
        return answer

    async def arm(self, request: Request) -> Answer:
        """Ask the robot to arm; the text is the stamp. A request from before a stop is refused."""
        if self.is_stopping:
            return Answer(False, "a stop is not confirmed yet: arm after it")
        stamp_ms = stamp_of(await text_of(request))
        if stamp_ms < self._stop_ms:
            return Answer(False, "a stop was asked for since: arm again if it is to move")
        return await self._ask("arm", Driver.arm)

    async def goal(self, request: Request) -> Answer:
        """Pass on a goal in odom, "X Y STAMP" or "X Y YAW STAMP" in m, m, deg; without YAW with any heading."""
        found = _GOAL.fullmatch(await text_of(request))
        if found is None:
            raise OmnidError('a goal is "X Y STAMP" or "X Y YAW STAMP" in m, m, deg')
        stamp_of(found[4])
        heading_rad = None if found[3] is None else math.radians(float(found[3]))
        return await self._ask("goal", lambda driver: driver.goal(float(found[1]), float(found[2]), heading_rad))

    async def _ask_by_text(
        self, kind: str, parse: Callable[[str], NavigationRequest], ask: Callable[[Driver, str], Answer], asked: Request
    ) -> Answer:
        """Pass on a request by the text of cmd/route or cmd/navigation, such as "repeat NAME stamp=STAMP"."""
        found = _STAMPED.fullmatch(await text_of(asked))
        text, stamp = ("", None) if found is None else found.groups()
        if not begins_nothing(parse(text)):
            stamp_of(stamp or "")
        return await self._ask(kind, lambda driver: ask(driver, text))

    async def _ask(self, kind: str, ask: Callable[[Driver], Answer]) -> Answer:
        """Ask the robot in a thread; refuse where another request of this kind still waits for its answer."""
        robot = self._robot()
        if kind in self._busy:
            return Answer(False, "another request has no answer yet")
        self._busy.add(kind)
        try:
            answer = await asyncio.to_thread(ask, robot.driver())
        finally:
            self._busy.discard(kind)
        return answer if answer.done else Answer(False, f"{robot.name} refuses: {answer.text}")

    def _robot(self) -> Robot:
        """Return the connection. Raise OmnidError where there is none yet."""
        if self.feed.robot is None:
            raise OmnidError(f"There is no connection: {self.feed.link}")
        return self.feed.robot

    async def drive(self, asked: Request) -> Answer:
        """Send the command of the stick, "FORWARD TURN STAMP PAGE": shares from -1 to 1, the latter counter-clockwise.

        STAMP is the server's time in the newest state that the page has shown; PAGE identifies an open page.
        """
        # 1. Parse the request, and read the robot's limits once.
        found = _STICK.fullmatch(await text_of(asked))
        forward, turn = (float(found[1]), float(found[2])) if found else (math.inf, math.inf)
        if found is None or max(abs(forward), abs(turn)) > 1.0:
            raise OmnidError('the stick sends "FORWARD TURN STAMP PAGE", the first two from -1 to 1')
        moves, stamp_ms, page, robot = bool(forward or turn), int(found[3]), found[4], self._robot()
        if (limits := self._limits) is None:
            limits = self._limits = await asyncio.to_thread(limits_of, robot)
        # 2. Refuse what may not drive now; a release always may.
        if self.is_stopping:
            return Answer(False, "a stop is not confirmed yet: drive after it")
        if self._page != page and time.monotonic() < self._held_until_s:
            return Answer(False, "another page drives")
        if moves and not is_recent(stamp_ms):
            return Answer(False, "the network is too slow to drive by it: the stick's request is more than 1 s late")
        if self._sending is not None and not self._sending.done():
            return Answer(False, "the robot does not take the last command: is it overloaded?")
        # 3. Send it. Other pages are refused until a state would be too old: some requests of this one may be lost.
        self._page, self._held_until_s = page, time.monotonic() + OLDEST_S
        velocity_mps = Stick.share * forward * limits.velocity_mps
        rate_radps = Stick.share * turn * limits.yaw_rate_radps
        send = partial(robot.driver().twist, velocity_mps, rate_radps)
        self._sending = asyncio.get_running_loop().run_in_executor(self._stick_thread, send)
        await asyncio.wait([self._sending], timeout=ANSWER_S / 2)  # a robot that does not read is not waited for
        if not moves:
            return Answer(True, "the stick is released: the robot stops")
        return Answer(True, f"it drives by the stick: {velocity_mps:+.2f} m/s, {math.degrees(rate_radps):+.0f}°/s")


async def _respond(act: Callable[[Request], Awaitable[Answer]], request: Request) -> Response:
    """Return the answer to a command as JSON, with status 409 if it was not done."""
    try:
        answer = await act(request)
    except OmnidError as error:
        answer = Answer(False, str(error))
    return JSONResponse(answer._asdict(), HTTPStatus.OK if answer.done else HTTPStatus.CONFLICT)


def stamp_of(text: str) -> int:
    """Return the stamp of a request: the server's time [ms] in the state that the page showed last.

    Raise OmnidError for any other text, and for a stamp that is too old.
    """
    if not re.fullmatch(r"\d{1,15}", text):
        raise OmnidError("a request that lets the robot move repeats server_ms, the server's time in the newest state")
    if not is_recent(int(text)):
        raise OmnidError("the request came too late: the page had no new state of the robot; ask again")
    return int(text)


async def text_of(request: Request) -> str:
    """Return the body of a request."""
    return (await request.body()).decode("utf-8", "replace")
