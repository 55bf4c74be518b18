"""Requests of commands: stops, and the progress of goals, routes and the teaching of a route until their end."""

from __future__ import annotations

import math
import select
import signal
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import closing, nullcontext
from typing import Final

from omnid.client import CONNECT_S, HERE, Answer, Diagnostics, Driver, NavigationReport, Robot, Subscription
from omnid.engine.logging_setup import HANDLER
from omnid.engine.process import handle_stop_signals
from omnid.errors import OmnidError
from omnid.navigation_state import NavigationState
from omnid.transport.bus_config import BusConfig
from omnid.transport.driver import ANSWER_S
from omnid.transport.status_names import DISARMED_BY_STOP, WHEELS, Key
from omnid.transport.stop_datagram import STOPPED, StopSender

SILENCE_S: Final = ANSWER_S  # A robot that sends no report for this time counts as gone.
# Time between two stops over the bus, and until the first: a datagram without an answer by then is behind a router;
# between two looks at the keyboard.
_REPEAT_S: Final = 0.15


def connected(bus: BusConfig) -> Robot:
    """Return a connection. Raise OmnidError where the robot cannot be reached."""
    return Robot(settings=bus, timeout_s=CONNECT_S)


def granted(robot: Robot, answer: Answer) -> str:
    """Return what the answer says. Raise OmnidError with the refusal."""
    if not answer.done:
        raise OmnidError(f"the robot {robot.name} refuses: {answer.text}")
    return answer.text


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


def drive_to_end(robot: Robot, driver: Driver, ask: Callable[[], Answer]) -> int:
    """Ask for a drive by the driver, and show it until its end. Return 0 if it has reached its goal.

    On a terminal it is one line that is rewritten, else a line for each new state. Ctrl-C, a terminal that closes and
    other ends of this program cancel it, also while the robot has not answered yet.
    """
    report, said, is_terminal = NavigationReport(), "", sys.stdout.isatty()
    try:
        with handle_stop_signals(signal.default_int_handler):
            granted(robot, ask())
            for report in reports_of(robot, driver.asked_ns):
                if is_terminal:
                    left = f", {report.left_m:.2f} m left" if math.isfinite(report.left_m) else ""
                    HANDLER.show(f"{report.words}{left}")
                elif report.words != said and report.command_ns == driver.asked_ns:
                    print(report.words, flush=True)
                said = report.words
    except KeyboardInterrupt:
        words = granted(robot, driver.navigate("cancel"))  # before a word is printed: the terminal may be gone
        HANDLER.show("")
        print(words)
        return 1
    HANDLER.show("")
    if report.command_ns != driver.asked_ns:
        print(f"not reached: {robot.name} follows another request now: {report.task}")
        return 1
    if is_terminal:
        print(report.words)
    return int(report.state != NavigationState.REACHED)


def record_until_enter(robot: Robot, name: str) -> int:
    """Show how long the route is until Enter, then have it written; Ctrl-C drops it. Return the exit code."""
    driver, reports = robot.driver(), robot.subscribe(NavigationReport)
    print(f"records {name}: drive it; Enter writes it, Ctrl-C drops it", flush=True)
    try:
        while not select.select([sys.stdin], [], [], _REPEAT_S)[0]:
            report = reports.wait(_REPEAT_S)
            if report is None:
                continue
            if report.teaching != name:
                raise OmnidError(f"the recording of {name} has ended: {report.refusal or 'by another program'}")
            HANDLER.show(f"{report.taught_m:.1f} m")
        sys.stdin.readline()
        granted(robot, driver.route("finish"))
    except KeyboardInterrupt:
        driver.route("stop")
        HANDLER.show("")
        print(f"{name} is dropped")
        return 130
    HANDLER.show("")
    print(f"{name} is written")
    return 0


def stop(bus: BusConfig, answer_s: float = ANSWER_S, connection: Robot | None = None) -> bool:
    """Stop the robot, and go on until its status confirms it; False where it has not in time.

    It goes as a datagram first, which needs no place among the sessions of the bus, and over the bus where that is not
    answered: over a connection that there is, else over a new one. Raise OmnidError where the robot cannot be reached.
    """
    deadline_s = time.monotonic() + answer_s
    with closing(StopSender(bus.robot, bus.connect or (HERE,))) as datagrams:
        if datagrams.ask(_REPEAT_S):
            return datagrams.ask(deadline_s - time.monotonic()) == STOPPED
        with (
            nullcontext(connection) if connection else Robot(settings=bus, timeout_s=CONNECT_S) as robot,
            robot.subscribe(Diagnostics) as statuses,
        ):
            driver = robot.driver()
            driver.require_connected()
            statuses.newest()  # The one that the robot has kept is from before this stop.
            while time.monotonic() < deadline_s:
                driver.stop()
                if _is_stopped(statuses) or datagrams.ask(0.0) == STOPPED:
                    return True
    return False


def _is_stopped(statuses: Subscription[Diagnostics]) -> bool:
    """True if a status within the time until the next stop says that a stop disarmed the robot."""
    report = statuses.wait(_REPEAT_S)
    return report is not None and report.value(WHEELS, Key.DISARMED_BY) == DISARMED_BY_STOP
