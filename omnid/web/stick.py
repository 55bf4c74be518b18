"""The stick of the page: the robot moves only while a browser repeats its requests.

A request is accepted only if its sender has seen a recent state of the robot. It carries the server's time in the
newest state that the page has shown, so a request that waited in a network moves nothing, and the browser's clock does
not matter. A browser that is closed sends nothing more, and the robot stops by its own deadline
(controller.deadlines.command_s).
"""

from __future__ import annotations

import asyncio
import math
import re
import time
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from typing import Final, NamedTuple

from starlette.requests import Request

from omnid.client import Answer
from omnid.core.control.velocity_limits import VelocityLimits
from omnid.errors import OmnidError
from omnid.monitor.teleop import FIRST_SHARE, limits_of
from omnid.web.feed import RobotFeed
from omnid.web.robot_requests import text_of
from omnid.web.snapshot import is_recent
from omnid.web.wheel_commands import WheelCommands, within

# Other pages are refused for this time after the last request of the page that drives: several of its requests may be
# lost before another page takes over.
HELD_S: Final = 1.0
_REQUEST: Final = re.compile(r"(-?[01](?:\.\d{1,4})?) (-?[01](?:\.\d{1,4})?) (\d{1,15}) ([0-9a-z]{1,16})")


class StickRequest(NamedTuple):
    """A request of a page."""

    forward: float  # -1 to 1
    turn: float  # -1 to 1, counter-clockwise
    stamp_ms: int  # the server's time in the newest state that the page has shown
    page: str  # identifies an open page

    @property
    def moves(self) -> bool:
        """True if it asks for a motion."""
        return bool(self.forward or self.turn)


def stick_request(text: str) -> StickRequest:
    """Parse "FORWARD TURN STAMP PAGE". Raise OmnidError for anything else."""
    found = _REQUEST.fullmatch(text)
    if found is None:
        raise OmnidError('the stick sends "FORWARD TURN STAMP PAGE", the first two from -1 to 1')
    forward, turn = float(found[1]), float(found[2])
    if max(abs(forward), abs(turn)) > 1.0:
        raise OmnidError("the stick goes from -1 to 1")
    return StickRequest(forward, turn, int(found[3]), found[4])


class StickCommands:
    """Sends a command for each request. One page drives at a time, and no command is sent before the last one ended."""

    def __init__(self, feed: RobotFeed, wheels: WheelCommands) -> None:
        self._feed, self._wheels = feed, wheels
        self._thread = ThreadPoolExecutor(1)
        self._limits: tuple[tuple[int, int], VelocityLimits] | None = None  # ends and restarts before they were read
        self._sending = False
        self._page, self._held_until_s = "", -math.inf

    async def drive(self, asked: Request) -> Answer:
        """Send the command that a request asks for."""
        try:
            request = stick_request(await text_of(asked))
        except OmnidError as error:
            return Answer(False, str(error))
        refusal = self._refusal(request)
        if refusal:
            return Answer(False, refusal)
        driver = self._wheels.ready_driver()
        if driver is None:
            return Answer(False, self._wheels.why_not())
        self._page, self._held_until_s = request.page, time.monotonic() + HELD_S
        self._sending = True
        try:
            limits = await self._limits_of_robot()
            # The first request reads the robot's limits, which may take so long that the request is no longer recent.
            if request.moves and not is_recent(request.stamp_ms):
                return Answer(False, "the stick is ready now")
            twist = (
                FIRST_SHARE * request.forward * limits.velocity_mps,
                FIRST_SHARE * request.turn * limits.yaw_rate_radps,
            )
            await within(self._thread, partial(driver.twist, *twist))
        finally:
            self._sending = False
        return Answer(
            True,
            f"it drives by the stick: {twist[0]:+.2f} m/s, {math.degrees(twist[1]):+.0f}°/s"
            if any(twist)
            else "the stick is released: it stands",
        )

    def _refusal(self, request: StickRequest) -> str:
        """Return why a request is refused, empty where it is not."""
        if self._wheels.is_stopping:
            return "a stop is not confirmed yet: drive after it"
        if self._page != request.page and time.monotonic() < self._held_until_s:
            return "another page drives"
        if request.moves and not is_recent(request.stamp_ms):
            return "the network is too slow to drive by it: the stick's request is more than 1 s late"
        if self._sending:
            return "the robot does not take the last command: is it overloaded?"
        return ""

    async def _limits_of_robot(self) -> VelocityLimits:
        """Return the robot's limits, read at the first call after its start; the defaults without a connection."""
        robot, state = self._feed.robot, self._feed.state
        if robot is None:
            return VelocityLimits()
        start = state.ends, state.restarts
        if self._limits is None or self._limits[0] != start or state.alive is False:
            self._limits = start, await asyncio.to_thread(limits_of, robot)
        return self._limits[1]
