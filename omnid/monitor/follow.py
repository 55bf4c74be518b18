"""Receiving, showing and writing a robot's messages until a signal or for a given time."""

from __future__ import annotations

import math
import time
from collections.abc import Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import IO, Final, TypeAlias

from drivers.logs.mcap_writer import LogWriter
from omnid.client import Robot
from omnid.engine.process import handle_stop_signals
from omnid.formats.tum import tum_row
from omnid.monitor.connecting import connected_until
from omnid.monitor.robot_state import Inbox, ReceivedMessage, RobotState
from omnid.monitor.screen import Screen
from omnid.sinks.files import check_outputs
from omnid.transport.bus_config import BusConfig
from omnid.transport.decode import Pose
from omnid.transport.topics import PUBLISHED, ros_name

SHOW_PERIOD_S: Final = 1.0
POLL_S: Final = 0.5  # Time between two checks for the end: as `omnid view`, so that Ctrl-C seems to act at once.
# Topics of which the newest message may have been sent before this program came: frames, map, path, status.
KEPT: Final = tuple(name.removeprefix("/") for name, topic in PUBLISHED.items() if topic.latched and not topic.realtime)


class TumWriter:
    """Writes the poses of the base as they arrive."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self._file: IO[str] | None = None
        self._newest_ns = -1

    def write(self, message: ReceivedMessage, pose: Pose | None) -> None:
        """Add a row for a pose; one that is not later than the last is left out."""
        if pose is None or pose.stamp_ns <= self._newest_ns:
            return
        if self._file is None:
            self._file = self._path.open("w", encoding="ascii", buffering=1)  # a row at a time
        self._newest_ns = pose.stamp_ns
        self._file.write(f"{tum_row(pose.stamp_ns, pose.T_odom_base)}\n")

    def close(self) -> None:
        """Close the file."""
        if self._file is not None:
            self._file.close()


class BusLogWriter:
    """Writes all messages to a log, with the robot's rig and configuration attached."""

    def __init__(self, path: Path, robot: Robot) -> None:
        self._robot = robot.name
        files = {f"{file}.toml": robot.query(name).encode() for file, name in (("rig", "rig"), ("omnid", "config"))}
        self._writer = LogWriter(path, {name: text for name, text in files.items() if text})

    def write(self, message: ReceivedMessage, pose: Pose | None) -> None:
        """Add a message under its ROS 2 name, logged at its time of arrival."""
        for name in (message.topic, f"/{message.topic}"):
            if name in PUBLISHED:
                schema = PUBLISHED[name].schema
                self._writer.write(ros_name(self._robot, name), schema, message.payload, message.received_ns)

    def close(self) -> None:
        """Complete the file."""
        self._writer.close()


Writer: TypeAlias = TumWriter | BusLogWriter


def listen(
    bus: BusConfig, tum: Path | None, mcap: Path | None, seconds: float | None, *, shows_load: bool = False
) -> int:
    """Show the robot until a signal or for a number of seconds. Return the exit code, 1 where no pose arrived.

    Ctrl-C, SIGTERM and a closed terminal leave whole files.

    shows_load: the share of each of its threads, in place of its state.
    """
    check_outputs([(name, path) for name, path in (("--tum", tum), ("--mcap", mcap)) if path is not None], [])
    state, screen = RobotState(), Screen(bus.robot, shows_load=shows_load)
    end_s = math.inf if seconds is None else time.monotonic() + seconds
    signals: list[int] = []
    with handle_stop_signals(lambda number, _: signals.append(number)), ExitStack() as stack:
        robot = connected_until(end_s, lambda: Robot(settings=bus), signals)
        if robot is not None:
            stack.enter_context(robot)
            writers: list[Writer] = [TumWriter(tum)] if tum else []
            if mcap:
                writers.append(BusLogWriter(mcap, robot))
            for writer in writers:
                stack.callback(writer.close)
            _follow(robot, state, screen, writers, end_s, signals)
    screen.show(state)
    return int(state.poses == 0)


def _follow(
    robot: Robot,
    state: RobotState,
    screen: Screen,
    writers: Sequence[Writer],
    end_s: float,
    signals: Sequence[int],
) -> None:
    inbox = Inbox()
    robot.kept_messages(inbox.put, KEPT)
    robot.on_message(inbox.put)
    robot.on_alive(state.set_alive)
    state.robots_there = robot.robots_there
    next_s = time.monotonic() + SHOW_PERIOD_S
    while not signals and (now_s := time.monotonic()) < end_s:
        message = inbox.get(min(next_s - now_s, end_s - now_s, POLL_S))
        state.forget_ended()
        if message is not None:
            pose = state.process(message)
            for writer in writers:
                writer.write(message, pose)
        if time.monotonic() >= next_s:
            screen.show(state, inbox.dropped)
            next_s = max(next_s + SHOW_PERIOD_S, time.monotonic())
