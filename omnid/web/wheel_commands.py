"""Stop from the page: the same, with the same answers, as `omnid stop`."""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import TypeVar

from omnid.client import Answer, Driver
from omnid.errors import OmnidError
from omnid.monitor.stopping import stop
from omnid.transport.driver import ANSWER_S
from omnid.web.feed import RobotFeed
from omnid.web.snapshot import server_ms

T = TypeVar("T")


class WheelCommands:
    """Sends stops. One is repeated until the robot's status confirms it; any number of browsers may ask for it."""

    def __init__(self, feed: RobotFeed) -> None:
        self._feed = feed
        self._thread = ThreadPoolExecutor(1)  # sending may block while the robot does not read
        self._stopping: asyncio.Task[Answer] | None = None
        self._driver: Driver | None = None
        self._again = False  # a stop was asked for since the newest one was sent
        self.stops = 0  # stops that were requested
        self.stop_ms = 0  # the server's time at the newest one

    @property
    def is_stopping(self) -> bool:
        """True while a stop is sent and not confirmed."""
        return self._stopping is not None and not self._stopping.done()

    async def stop(self) -> Answer:
        """Stop the wheels, and wait until the robot confirms it, for at most 10 s after the newest request."""
        self.stops += 1
        self.stop_ms = server_ms()
        self._again = True
        if self._stopping is None or self._stopping.done():
            self._stopping = asyncio.create_task(self._stop())
        return await asyncio.shield(self._stopping)  # a browser that goes does not end it

    async def _stop(self) -> Answer:
        while self._again:
            self._again = False
            try:
                stopping = asyncio.get_running_loop().run_in_executor(
                    self._thread, lambda: stop(self._feed.bus, connection=self._feed.robot)
                )
                answer = Answer(True, "the robot stops: its wheels stand until it is armed")
                if not await stopping:
                    answer = Answer(False, "the stop is NOT confirmed: use the emergency stop")
            except OmnidError as error:
                answer = Answer(False, f"the stop is NOT confirmed: use the emergency stop. {error}")
        return answer

    def ready_driver(self) -> Driver | None:
        """Return the sender; None without a connection to the robot."""
        if self._driver is None and self._feed.robot is not None:
            self._driver = self._feed.robot.driver()
        return self._driver

    def why_not(self) -> str:
        """Return why there may be no answer."""
        if self._feed.link:
            return f"There is no connection: {self._feed.link}"
        if self._driver is None or not self._driver.connected:
            return "No robot of that name receives commands there: does its daemon run, with a motor?"
        return (
            "Either this program must not command it (access_control in zenoh's file), or the clocks differ; "
            "see `refused` in the entry of the wheels"
        )


async def within(thread: ThreadPoolExecutor, send: Callable[[], T]) -> T | None:
    """Call a function in a thread; return None if it has not returned in time, because the robot does not read."""
    call = asyncio.get_running_loop().run_in_executor(thread, send)
    done, _ = await asyncio.wait([call], timeout=ANSWER_S / 2)
    return call.result() if done else None
