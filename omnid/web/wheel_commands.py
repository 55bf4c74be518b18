"""Stop from the page: the same command with the same answers as `omnid stop`."""

from __future__ import annotations

import asyncio
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from typing import Final, TypeVar

from omnid.client import CONNECT_S, HERE, Answer, Driver
from omnid.transport.driver import ANSWER_S
from omnid.transport.status_names import DISARMED_BY_STOP, WHEELS, Key
from omnid.transport.stop_datagram import STOPPED, StopSender
from omnid.web.feed import RobotFeed

T = TypeVar("T")
REPEAT_S: Final = 0.2  # between two stops
_POLL_S: Final = 0.02
_DATAGRAM_S: Final = 0.05


class WheelCommands:
    """Sends stops. One goes on until the robot's status confirms it; any number of browsers may ask for it.

    Sending may block while the robot does not read: stops have a thread of their own.
    """

    def __init__(self, feed: RobotFeed) -> None:
        self._feed = feed
        self._stop_thread = ThreadPoolExecutor(1)
        self._driver: Driver | None = None
        self._stopping: asyncio.Task[Answer] | None = None
        self._again = False  # a stop was asked for since the newest one was sent
        self.stops = 0  # that were asked for

    @property
    def is_stopping(self) -> bool:
        """True while a stop is sent and not confirmed."""
        return self._stopping is not None and not self._stopping.done()

    async def stop(self) -> Answer:
        """Stop the wheels, and wait until the robot confirms it.

        For at most 10 s after the newest request; 2 s where no robot receives commands.
        """
        self.stops += 1
        self._again = True
        if not self.is_stopping:
            self._stopping = asyncio.create_task(self._stop())
        assert self._stopping is not None
        return await asyncio.shield(self._stopping)  # a browser that goes does not end it

    async def _stop(self) -> Answer:
        begin_s = time.monotonic()
        while time.monotonic() < begin_s + (ANSWER_S if self._is_received else CONNECT_S):
            if self._again:
                self._again, begin_s = False, time.monotonic()
            driver, reports = self.ready_driver(), self._feed.wheel_reports
            if await asyncio.to_thread(self._stops_by_datagram) and not self._again:
                return Answer(True, "the robot stops: its wheels stand until it is armed")
            if driver is not None:
                await within(self._stop_thread, driver.stop)
                reported = await self._wait_for(partial(self._reported_since, reports), REPEAT_S)
                if reported and not self._again and self._is_stopped():
                    return Answer(True, "the robot stops: its wheels stand until it is armed")
            else:
                await asyncio.sleep(_POLL_S)
        return Answer(False, f"the stop is NOT confirmed: use the emergency stop. {self.why_not()}")

    def _stops_by_datagram(self) -> bool:
        """Ask for a stop beside the sessions of the bus, which may all be taken; return whether it is confirmed."""
        bus = self._feed.bus
        with StopSender(bus.robot, bus.connect or (HERE,)) as datagrams:
            return datagrams.ask(_DATAGRAM_S) == STOPPED

    def ready_driver(self) -> Driver | None:
        """Return the sender; None without a connection to the robot."""
        if self._driver is None and self._feed.robot is not None:
            self._driver = self._feed.robot.driver()
        return self._driver

    @property
    def _is_received(self) -> bool:
        """True if a robot receives commands."""
        return self._driver is not None and self._driver.connected

    async def _wait_for(self, happens: Callable[[], bool], timeout_s: float) -> bool:
        deadline_s = time.monotonic() + timeout_s
        while not happens():
            if time.monotonic() > deadline_s:
                return False
            await asyncio.sleep(_POLL_S)
        return True

    def _reported_since(self, reports: int) -> bool:
        return self._feed.wheel_reports > reports

    def _is_stopped(self) -> bool:
        status = self._feed.state.statuses.get(WHEELS)
        return status is not None and status.values.get(Key.DISARMED_BY) == DISARMED_BY_STOP

    def why_not(self) -> str:
        """Return why there may be no answer."""
        if self._feed.link:
            return f"There is no connection: {self._feed.link}"
        if not self._is_received:
            return "No robot of that name receives commands there: does its daemon run, with a motor?"
        return ("Either this program must not command it (bus.command_users, bus.command_names), or the clocks differ; "
                "see `refused` in the entry of the wheels")


async def within(thread: ThreadPoolExecutor, send: Callable[[], T]) -> T | None:
    """Call a function in a thread; return None if it has not returned in time, because the robot does not read."""
    call = asyncio.get_running_loop().run_in_executor(thread, send)
    done, _ = await asyncio.wait([call], timeout=ANSWER_S / 2)
    return call.result() if done else None
