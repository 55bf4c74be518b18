"""Requests of the page to the robot: those of `omnid arm`, `goto`, `route` and `map save`, with the same answers."""

from __future__ import annotations

import asyncio
import math
import re
from collections.abc import Callable
from typing import Final

from starlette.requests import Request

from omnid.client import Answer, Driver
from omnid.core.navigation.requests import NavigationRequest, may_begin_motion, navigation_verb, route_request
from omnid.errors import OmnidError
from omnid.web.feed import RobotFeed
from omnid.web.snapshot import is_recent

# The longest request, a route with a name of 64 letters and its options, has less than half of these bytes.
LONGEST_BODY: Final = 256
# A connection whose body has not arrived after this time is ended, so that slow ones do not collect.
BODY_S: Final = 5.0
_NUMBER: Final = r"(-?\d{1,6}(?:\.\d{1,4})?)"
_GOAL: Final = re.compile(rf"{_NUMBER} {_NUMBER}(?: {_NUMBER})? (\d{{1,15}})")
_STAMP: Final = re.compile(r"\d{1,15}")
_STAMPED: Final = re.compile(r"(.*?)(?: stamp=(\d{1,15}))?", re.DOTALL)


class RobotRequests:
    """Passes requests on to the robot.

    What lets the robot move (arm, goal, repeat, resume) carries the server's time in the newest state that the page has
    shown, so a request that waited in a network moves nothing. What ends a motion needs none.

    A request occupies a thread until it is answered, so only one of each kind is open. arms: number of requests to
    arm so far.
    """

    def __init__(self, feed: RobotFeed) -> None:
        self._feed = feed
        self._busy: set[str] = set()  # kinds of the requests that wait for an answer
        self.arms = 0

    async def arm(self, request: Request, since_ms: int = 0) -> Answer:
        """Ask the robot to arm; the text is the stamp. since_ms: earlier requests are from before a stop."""
        try:
            stamp_ms = stamp_of(await text_of(request))
        except OmnidError as error:
            return Answer(False, str(error))
        if stamp_ms < since_ms:
            return Answer(False, "a stop was asked for since: arm again if it is to move")
        self.arms += 1
        return await self._asked("arm", Driver.arm)

    async def route(self, request: Request) -> Answer:
        """Pass on a request in the words of cmd/route: "teach NAME", "finish", "repeat NAME stamp=STAMP" or "stop"."""
        return await self._asked_in_words("route", request, route_request, Driver.route)

    async def navigation(self, request: Request) -> Answer:
        """Pass on "cancel", "pause" or "resume stamp=STAMP"."""
        return await self._asked_in_words("navigation", request, navigation_verb, Driver.navigate)

    async def goal(self, request: Request) -> Answer:
        """Pass on a goal in odom: see goal_of."""
        try:
            goal = goal_of(await text_of(request))
        except OmnidError as error:
            return Answer(False, str(error))
        return await self._asked("goal", lambda driver: driver.goal(*goal))

    async def save_map(self) -> Answer:
        """Ask the robot to save its map now."""
        return await self._asked("map", Driver.save_map)

    async def _asked_in_words(
        self,
        kind: str,
        request: Request,
        parse: Callable[[str], NavigationRequest],
        ask: Callable[[Driver, str], Answer],
    ) -> Answer:
        try:
            found = _STAMPED.fullmatch(await text_of(request))
            text, stamp = ("", None) if found is None else found.groups()
            if may_begin_motion(parse(text)):
                stamp_of(stamp or "")
        except OmnidError as error:
            return Answer(False, str(error))
        return await self._asked(kind, lambda driver: ask(driver, text))

    async def _asked(self, kind: str, ask: Callable[[Driver], Answer]) -> Answer:
        """Ask the robot in a thread; refuse where another request of this kind still waits for its answer."""
        robot = self._feed.robot
        if robot is None:
            return Answer(False, f"There is no connection: {self._feed.link}")
        if kind in self._busy:
            return Answer(False, "another request has no answer yet")
        self._busy.add(kind)
        try:
            answer = await asyncio.to_thread(ask, robot.driver())
        except OmnidError as error:
            return Answer(False, str(error))
        finally:
            self._busy.discard(kind)
        return answer if answer.done else Answer(False, f"{robot.name} refuses: {answer.text}")


def goal_of(text: str) -> tuple[float, float, float | None]:
    """Return x, y [m] and the heading [rad] of a goal in odom; a heading of None leaves it open.

    text: "X Y STAMP" or "X Y YAW STAMP" in m, m, deg; the stamp is the server's time in the state that the page showed
    last. Raise OmnidError for any other text, and for a stamp that is too old.
    """
    found = _GOAL.fullmatch(text)
    if found is None:
        raise OmnidError('a goal is "X Y STAMP" or "X Y YAW STAMP" in m, m, deg')
    stamp_of(found[4])
    return float(found[1]), float(found[2]), None if found[3] is None else math.radians(float(found[3]))


def stamp_of(text: str) -> int:
    """Return the stamp of a request: the server's time [ms] in the state that the page showed last.

    Raise OmnidError for any other text, and for a stamp that is too old.
    """
    if not _STAMP.fullmatch(text):
        raise OmnidError("a request that lets the robot move repeats server_ms, the server's time in the newest state")
    if not is_recent(int(text)):
        raise OmnidError("the request came too late: the page had no new state of the robot; ask again")
    return int(text)


async def text_of(request: Request, longest: int = LONGEST_BODY) -> str:
    """Return the body of a request. Raise OmnidError above `longest` bytes, or if it does not arrive within BODY_S."""
    body = bytearray()
    try:
        async with asyncio.timeout(BODY_S):
            async for chunk in request.stream():
                body += chunk
                if len(body) > longest:
                    raise OmnidError(f"a request of at most {longest} bytes was expected")
    except TimeoutError:
        raise OmnidError("the request did not come") from None
    return body.decode("utf-8", "replace")
