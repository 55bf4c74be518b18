"""Save the map of a robot from another program, and wait for its answer in the status."""

from __future__ import annotations

import time
from typing import Final

from omnid.client import Diagnostics, Robot
from omnid.errors import OmnidError
from omnid.monitor.arming import CONNECT_S, driver_of
from omnid.transport.bus_config import BusConfig
from omnid.transport.codec import OK, DiagnosticStatus
from omnid.transport.navigation_codec import string_cdr
from omnid.transport.status_names import MAP_FILE, Key, count
from omnid.transport.topics import MAP, SAVE_MAP

ANSWER_S: Final = 10.0  # the copy is made after a pose, written by a thread and reported with the next status
_REPORTED_S: Final = 3.0  # longer than the usual live.status_s


def save_map(bus: BusConfig) -> str:
    """Ask the robot to save its map now; return what became of it, one line.

    Raise OmnidError where it cannot be reached, keeps no map in a file, cannot write it, or does not answer in time.
    """
    with Robot(settings=bus, timeout_s=CONNECT_S) as robot, robot.subscribe(Diagnostics) as statuses:
        driver = driver_of(robot)

        def reported(timeout_s: float) -> DiagnosticStatus | None:
            deadline_s = time.monotonic() + timeout_s
            while time.monotonic() < deadline_s:
                report = statuses.wait(deadline_s - time.monotonic())
                for status in report.statuses if report is not None else ():
                    if status.name == MAP_FILE:
                        return status
            return None

        before = reported(_REPORTED_S)
        if before is None:
            raise OmnidError(f"{bus.robot} keeps no map in a file: start its daemon with --map FILE.omap, or set "
                             "places.map")
        driver.send(MAP, string_cdr(SAVE_MAP))
        deadline_s = time.monotonic() + ANSWER_S
        while time.monotonic() < deadline_s:
            status = reported(deadline_s - time.monotonic())
            if status is not None and _number(status, Key.ANSWERED) != _number(before, Key.ANSWERED):
                return _outcome(bus.robot, before, status)
    raise OmnidError(f"{bus.robot} has not answered within {ANSWER_S:g} s: either this program must not command it "
                     "(bus.command_users, bus.command_names), or it gives no poses; see `omnid listen`")


def _outcome(robot: str, before: DiagnosticStatus, after: DiagnosticStatus) -> str:
    if after.level != OK:
        raise OmnidError(f"{robot} cannot save its map: {after.message}")
    is_new = _number(after, Key.SAVES) != _number(before, Key.SAVES)
    return "the map is saved" if is_new else "the map in the file has all that is known already"


def _number(status: DiagnosticStatus, key: Key) -> int | None:
    return count(status.values.get(key, ""))
