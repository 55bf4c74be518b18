"""Stop and arm a robot from another program, and wait for its answer in the status."""

from __future__ import annotations

import time
from typing import Final

from omnid.client import HERE, Diagnostics, Driver, Robot, Subscription
from omnid.errors import OmnidError
from omnid.transport.bus_config import BusConfig
from omnid.transport.commands import SAME_NAME
from omnid.transport.status_names import BUS, DISARMED_BY_STOP, SAME_NAME_COUNT, WHEELS, Key
from omnid.transport.stop_datagram import STOPPED, StopSender

CONNECT_S: Final = 2.0
ANSWER_S: Final = 10.0  # longer than the usual live.status_s
_DATAGRAM_S: Final = 0.15  # after which a stop goes over the bus, too: the robot is behind a router, or far away
_REPEAT_S: Final = 0.2  # between two stops
_POLL_S: Final = 0.02


def arm(bus: BusConfig, answer_s: float = ANSWER_S) -> str:
    """Arm the robot; return the reason where it refuses, empty where it is armed.

    Raise OmnidError where it cannot be reached, does not obey this program, or does not answer in time.
    """
    with Robot(settings=bus, timeout_s=CONNECT_S) as robot, robot.subscribe(Diagnostics) as statuses:
        driver = driver_of(robot)
        stamp_ns = driver.arm()
        deadline_s = time.monotonic() + answer_s
        while time.monotonic() < deadline_s:
            report = statuses.wait(deadline_s - time.monotonic())
            if report is not None and report.value(BUS, SAME_NAME_COUNT) not in ("", "0"):
                return f"{SAME_NAME}; change bus.robot of one of them"
            if report is not None and answered_ns(report.value(WHEELS, Key.ARM_STAMP_NS)) >= stamp_ns:
                return report.value(WHEELS, Key.ARM_REFUSAL)
    raise OmnidError(f"{bus.robot} has not answered within {answer_s:g} s: either this program must not command it "
                     "(bus.command_users, bus.command_names), or the clocks differ by more than "
                     "controller.deadlines.command_s; see `refused` in `omnid listen`")


def stop(bus: BusConfig, answer_s: float = ANSWER_S) -> bool:
    """Stop the robot, and go on until its status confirms it; False where it has not in time.

    It goes as a datagram first, which needs no place among the sessions of the bus, and over the bus where that is not
    answered. Raise OmnidError where the robot cannot be reached.
    """
    deadline_s = time.monotonic() + answer_s
    with StopSender(bus.robot, bus.connect or (HERE,)) as datagrams:
        if datagrams.ask(_DATAGRAM_S):
            return datagrams.ask(deadline_s - time.monotonic()) == STOPPED
        with Robot(settings=bus, timeout_s=CONNECT_S) as robot, robot.subscribe(Diagnostics) as statuses:
            driver = driver_of(robot)
            while time.monotonic() < deadline_s:
                driver.stop()
                if _is_stopped(statuses) or datagrams.ask(0.0) == STOPPED:
                    return True
    return False


def driver_of(robot: Robot) -> Driver:
    """Return a sender as soon as the robot receives its commands. Raise OmnidError where it does not."""
    driver, deadline_s = robot.driver(), time.monotonic() + CONNECT_S
    while not driver.connected:
        if time.monotonic() > deadline_s:
            raise OmnidError(f"no robot {robot.name!r} receives commands there: check --robot and --connect, and that "
                             "its daemon runs with a motor")
        time.sleep(_POLL_S)
    return driver


def answered_ns(text: str) -> int:
    """Return the stamp of the answered request in a status, ns; 0 for a text that is none."""
    return int(text) if text.isascii() and text.isdigit() and len(text) < 20 else 0


def _is_stopped(statuses: Subscription[Diagnostics]) -> bool:
    """True if a status within the time until the next stop says that a stop disarmed the robot."""
    report = statuses.wait(_REPEAT_S)
    return report is not None and report.value(WHEELS, Key.DISARMED_BY) == DISARMED_BY_STOP
