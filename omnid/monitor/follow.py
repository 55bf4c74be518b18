"""Follows a robot until it is enough."""

from __future__ import annotations

import math
import time
from collections.abc import Sequence
from contextlib import ExitStack, suppress
from pathlib import Path
from typing import Final, TypeAlias

from omnid.client import Report, Robot
from omnid.monitor.robot_state import Inbox, RobotState
from omnid.monitor.screen import Screen
from omnid.monitor.writers import BusLogWriter, TumWriter
from omnid.sinks.files import check_outputs
from omnid.transport.bus_config import BusConfig
from omnid.transport.session import Unreachable

SHOWN_S: Final = 1.0
_PATIENCE_S: Final = 0.5
Keeper: TypeAlias = TumWriter | BusLogWriter


def listen(bus: BusConfig, tum: Path | None, mcap: Path | None, seconds: float | None) -> int:
    """Shows the robot until Ctrl-C or for so many seconds; the exit code, 1 where not one pose came."""
    check_outputs([(name, path) for name, path in (("--tum", tum), ("--mcap", mcap)) if path is not None], [])
    heard, screen = RobotState(), Screen(bus.robot)
    end_s = math.inf if seconds is None else time.monotonic() + seconds
    with suppress(KeyboardInterrupt), ExitStack() as ends:
        robot = _reached(bus, end_s, screen)
        if robot is not None:
            ends.enter_context(robot)
            keepers: list[Keeper] = [TumWriter(tum)] if tum else []
            keepers += [BusLogWriter(mcap, robot)] if mcap else []
            for keeper in keepers:
                ends.callback(keeper.close)
            _follow(robot, heard, screen, keepers, end_s)
    screen.show(heard)
    return int(heard.poses == 0)


def _reached(bus: BusConfig, end_s: float, screen: Screen) -> Robot | None:
    """The robot as soon as something listens there."""
    while time.monotonic() < end_s:
        try:
            return Robot(settings=bus)
        except Unreachable as error:
            screen.say(str(error))
        time.sleep(_PATIENCE_S)
    return None


def _follow(robot: Robot, heard: RobotState, screen: Screen, keepers: Sequence[Keeper], end_s: float) -> None:
    mailbox = Inbox()
    robot.each(mailbox.take)
    status = robot.subscribe(Report)
    next_s = time.monotonic() + SHOWN_S
    heard.take_report(status.newest())
    status.close()
    while (now_s := time.monotonic()) < end_s:
        letter = mailbox.next(min(next_s, end_s) - now_s)
        if letter is not None:
            pose = heard.take(letter)
            for keeper in keepers:
                keeper(letter, pose)
        if time.monotonic() >= next_s:
            screen.show(heard, mailbox.forgotten)
            next_s = max(next_s + SHOWN_S, time.monotonic())
