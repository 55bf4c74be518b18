"""All robots behind a router: their messages from the bus to the one channel of the fleet's page.

The page gets the newest table only; positions and states of each robot are in it. Stops go to all robots at once.
"""

from __future__ import annotations

import asyncio
import hashlib
import time
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from typing import Any, Final

from omnid.client import Answer, Fleet, Unreachable
from omnid.monitor.fleet import FLEET_TOPICS, FleetState, severity, word_of, worst_part
from omnid.monitor.robot_state import Inbox, RobotState
from omnid.plain_text import plain
from omnid.transport.bus_config import BusConfig
from omnid.transport.status_names import DISARMED_BY_STOP, WHEELS, Key, short_name
from omnid.web.browsers import Browsers
from omnid.web.channels import Newest, compact
from omnid.web.snapshot import finite
from omnid.web.wheel_commands import within

SHOW_S: Final = 0.5
STOP_S: Final = 10.0  # A robot that has not confirmed a stop after this time is named.
REPEAT_S: Final = 0.2
_RETRY_S: Final = 0.5
_POLL_S: Final = 0.02
_MOST_AT_ONCE: Final = 200  # messages, before others of this process have their turn
_MOST_NAMED: Final = 10


def robot_key(name: str) -> str:
    """Return the name of a robot in addresses: a hash, because it may hold any letters."""
    return hashlib.sha256(name.encode()).hexdigest()[:24]


class FleetFeed:
    """Follows all robots, and stops them."""

    def __init__(self, bus: BusConfig) -> None:
        """bus: settings of the connection, which has been checked."""
        self._bus = bus
        self.state, self.inbox = FleetState(), Inbox()
        self.link = "not connected yet"  # why there is no connection; empty with one
        self.stops = 0  # stops that were requested
        self._fleet: Fleet | None = None
        self._channel = Newest("fleet", self._encode)
        self.browsers = Browsers((self._channel,))
        self._thread = ThreadPoolExecutor(1)  # sending may block while a robot does not read

    async def run(self) -> None:
        """Connect as soon as the router can be reached, and follow until this task is cancelled."""
        try:
            await asyncio.gather(self._connect(), self._process())
        finally:
            if self._fleet is not None:
                self._fleet.close()

    def name_of(self, key: str) -> str | None:
        """Return the name of a robot that has been seen, by its key."""
        return next((name for name in self.state.robots if robot_key(name) == key), None)

    async def stop_all(self) -> Answer:
        """Stop all robots, repeated until the status of each confirms it, and name those that have not."""
        self.stops += 1
        if self._fleet is None:
            return Answer(False, f"no stop is sent: use the emergency stops. There is no connection: {self.link}")
        reports = {
            name: state.statuses.get(WHEELS) for name, state in self.state.robots.items() if state.alive is not False
        }
        with_wheels = {name for name, report in reports.items() if report or not self.state.robots[name].statuses}
        waiting, end_s = set(with_wheels), time.monotonic() + STOP_S
        await within(self._thread, partial(_stop_each, self._fleet, sorted(reports.keys() - with_wheels)))
        while waiting and time.monotonic() < end_s:
            await within(self._thread, partial(_stop_each, self._fleet, sorted(waiting)))
            next_s = time.monotonic() + REPEAT_S
            while waiting and time.monotonic() < next_s:
                await asyncio.sleep(_POLL_S)
                waiting = {name for name in waiting if not _confirms(self.state.robots[name], reports[name])}
        confirmed = len(with_wheels) - len(waiting)
        if not waiting:
            return Answer(
                bool(with_wheels),
                f"all {confirmed} robots stop: their wheels stand until they are armed"
                if with_wheels
                else "no robot with wheels is there",
            )
        named = ", ".join(plain(name) for name in sorted(waiting)[:_MOST_NAMED])
        more = f" and {len(waiting) - _MOST_NAMED} others" if len(waiting) > _MOST_NAMED else ""
        return Answer(
            False,
            f"NOT confirmed by {named}{more}: use the emergency stop. {confirmed} of {len(with_wheels)} robots stop",
        )

    async def _connect(self) -> None:
        while self._fleet is None:
            try:
                self._fleet = await asyncio.to_thread(Fleet, self._bus)
            except Unreachable as error:
                self.link = str(error)
                await asyncio.sleep(_RETRY_S)
        self.link = ""
        self._fleet.on_alive(self.state.note_alive)
        await asyncio.to_thread(self._fleet.on_message, self.inbox.put, FLEET_TOPICS)

    async def _process(self) -> None:
        """Take messages in small groups, and send the table at SHOW_S."""
        next_s = 0.0
        while True:
            taken = self._take()
            if time.monotonic() >= next_s:
                next_s = time.monotonic() + SHOW_S
                self._channel.changed()
                self.browsers.notify()
            await asyncio.sleep(0.0 if taken == _MOST_AT_ONCE else _POLL_S)

    def _take(self) -> int:
        self.state.take_alive()
        for count in range(_MOST_AT_ONCE):
            message = self.inbox.get(0.0)
            if message is None:
                return count
            self.state.process(message)
        return _MOST_AT_ONCE

    def _encode(self) -> str:
        robots = sorted(self.state.robots.items(), key=lambda entry: (-severity(entry[1]), entry[0]))
        return compact(
            {
                "type": "fleet",
                "link": plain(self.link),
                "refused": len(self.state.refused),
                "dropped": self.inbox.dropped,
                "robots": [_row(name, state) for name, state in robots],
            }
        )


def _row(name: str, state: RobotState) -> dict[str, Any]:
    """Return the entry of a robot in the message `fleet`."""
    pose, worst = state.pose, worst_part(state)
    wheels = None if state.alive is False else state.statuses.get(WHEELS)
    return {
        "key": robot_key(name),
        "name": plain(name),
        "level": severity(state),
        "state": word_of(state),
        "rate_hz": finite(state.rate_hz),
        "silent_s": None if pose is None else round(state.time_since_pose_s),
        "x_m": None if pose is None else finite(pose.x_m),
        "y_m": None if pose is None else finite(pose.y_m),
        "yaw_rad": None if pose is None else finite(pose.yaw_rad),
        "armed": None if wheels is None else wheels.values.get(Key.ARMED) == "1",
        "problem": "" if worst is None else plain(f"{short_name(worst.name)}: {worst.message}"),
    }


def _stop_each(fleet: Fleet, names: list[str]) -> None:
    for name in names:
        fleet.stop(name)


def _confirms(state: RobotState, before: object) -> bool:
    """True if a status that arrived since then says that a stop disarmed the robot."""
    status = state.statuses.get(WHEELS)
    return status is not None and status is not before and status.values.get(Key.DISARMED_BY) == DISARMED_BY_STOP
