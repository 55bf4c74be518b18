"""Stops, and the progress of a drive until its end."""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import closing, nullcontext
from typing import Final

from omnid.client import ANSWER_S, HERE, Diagnostics, NavigationReport, Robot
from omnid.errors import OmnidError
from omnid.navigation_state import NavigationState
from omnid.transport.session import BusConfig
from omnid.transport.status_names import DISARMED_BY_STOP, WHEELS, Key
from omnid.transport.stop_datagram import STOPPED, StopSender

SILENCE_S: Final = ANSWER_S  # A robot that sends no report for this time counts as gone.
# Time between two stops over the bus, and until the first: a datagram without an answer by then is behind a router.
REPEAT_S: Final = 0.15


def reports_of(robot: Robot, command_ns: int) -> Iterator[NavigationReport]:
    """Yield the reports of the drive that a request with this stamp began, and last the one with which it ended.

    That is one of another request where that has taken the place of this one. Raise OmnidError where the robot is
    silent for SILENCE_S.
    """
    begun, deadline_s = False, time.monotonic() + SILENCE_S
    with robot.subscribe(NavigationReport) as reports:
        while (report := reports.wait(deadline_s - time.monotonic())) is not None:
            is_own = report.command_ns == command_ns
            if is_own:
                begun, deadline_s = True, time.monotonic() + SILENCE_S
            if begun:
                yield report
                if not is_own or NavigationState(report.state).is_end:
                    return
    raise OmnidError(
        f"{robot.name} has been silent for {SILENCE_S:g} s: look at it; if only the network between is gone, it drives "
        "on (`omnid stop`, `omnid listen`)"
    )


def stop(bus: BusConfig, answer_s: float = ANSWER_S, connection: Robot | None = None) -> bool:
    """Stop the robot, and go on until its status confirms it; False where it has not in time.

    It goes as a datagram first, which needs no place among the sessions of the bus, and over the bus where that is not
    answered: over a connection that there is, else over a new one. Raise OmnidError where the robot cannot be reached.
    """
    deadline_s = time.monotonic() + answer_s
    with closing(StopSender(bus.robot, bus.connect or (HERE,))) as datagrams:
        if datagrams.ask(REPEAT_S):
            return datagrams.ask(deadline_s - time.monotonic()) == STOPPED
        with (
            nullcontext(connection) if connection else Robot(settings=bus) as robot,
            robot.subscribe(Diagnostics) as statuses,
        ):
            driver = robot.driver()
            driver.require_connected()
            statuses.newest()  # The one that the robot has kept is from before this stop.
            while time.monotonic() < deadline_s:
                driver.stop()
                report = statuses.wait(REPEAT_S)
                if report is not None and report.value(WHEELS, Key.DISARMED_BY) == DISARMED_BY_STOP:
                    return True
                if datagrams.ask(0.0) == STOPPED:
                    return True
    return False
