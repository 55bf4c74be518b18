"""Requests from the page: the same, with the same answers, as those of `omnid arm`, `goto`, `route` and `map save`."""

from __future__ import annotations

import asyncio
import math
import re
from collections.abc import Callable
from typing import Final

from starlette.requests import Request

from omnid.client import Answer, Driver
from omnid.core.navigation.requests import navigation_verb, route_request
from omnid.errors import OmnidError
from omnid.web.feed import RobotFeed
from omnid.web.snapshot import is_recent

LONGEST_BODY: Final = 256  # bytes
BODY_S: Final = 5.0
_NUMBER: Final = r"(-?\d{1,6}(?:\.\d{1,4})?)"
_GOAL: Final = re.compile(rf"{_NUMBER} {_NUMBER}(?: {_NUMBER})? (\d{{1,15}})")


class RobotRequests:
    """Passes requests on to the robot, one of each kind at a time: each has a thread until it is answered."""

    def __init__(self, feed: RobotFeed) -> None:
        self._feed = feed
        self._busy: set[str] = set()
        self.arms = 0  # that were asked for

    async def arm(self) -> Answer:
        """Ask the robot to arm."""
        self.arms += 1
        return await self._asked("arm", Driver.arm)

    async def route(self, request: Request) -> Answer:
        """Pass on what a text of cmd/route says: "teach NAME", "finish", "repeat NAME", "stop"."""
        return await self._asked_in_words("route", request, route_request, Driver.route)

    async def navigation(self, request: Request) -> Answer:
        """Pass on cancel, pause or resume."""
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
        self, kind: str, request: Request, check: Callable[[str], object], ask: Callable[[Driver, str], Answer]
    ) -> Answer:
        try:
            text = await text_of(request)
            check(text)
        except OmnidError as error:
            return Answer(False, str(error))
        return await self._asked(kind, lambda driver: ask(driver, text))

    async def _asked(self, kind: str, ask: Callable[[Driver], Answer]) -> Answer:
        """Ask the robot in a thread, unless another request of this kind waits for its answer."""
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
    """Return x, y [m] and the heading [rad], None where it is left open. Raise OmnidError for no goal, or a late one.

    text: "X Y STAMP" or "X Y YAW STAMP", m, m, deg, and the server's time in the state that the page showed last.
    """
    found = _GOAL.fullmatch(text)
    if found is None:
        raise OmnidError('a goal is "X Y STAMP" or "X Y YAW STAMP" in m, m, deg')
    if not is_recent(int(found[4])):
        raise OmnidError("the goal came too late: the page had no new state of the robot; choose it again")
    return float(found[1]), float(found[2]), None if found[3] is None else math.radians(float(found[3]))


async def text_of(request: Request) -> str:
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
