"""Stop a robot from another program, and wait until it confirms that."""

from __future__ import annotations

import time
from contextlib import nullcontext
from typing import Final

from omnid.client import HERE, Diagnostics, Robot, Subscription
from omnid.transport.bus_config import BusConfig
from omnid.transport.driver import ANSWER_S, CONNECT_S
from omnid.transport.status_names import DISARMED_BY_STOP, WHEELS, Key
from omnid.transport.stop_datagram import STOPPED, StopSender

_DATAGRAM_S: Final = 0.15  # After this time a stop goes over the bus, too: the robot is behind a router, or far away.
_REPEAT_S: Final = 0.2  # Time between two stops.


def stop(bus: BusConfig, answer_s: float = ANSWER_S, connection: Robot | None = None) -> bool:
    """Stop the robot, and go on until its status confirms it; False where it has not in time.

    It goes as a datagram first, which needs no place among the sessions of the bus, and over the bus where that is not
    answered: over a connection that there is, else over a new one. Raise OmnidError where the robot cannot be reached.
    """
    deadline_s = time.monotonic() + answer_s
    with StopSender(bus.robot, bus.connect or (HERE,)) as datagrams:
        if datagrams.ask(_DATAGRAM_S):
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
