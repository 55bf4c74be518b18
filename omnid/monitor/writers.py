"""Files of what a robot says: its path in the TUM format, and a log of everything."""

from __future__ import annotations

from pathlib import Path
from typing import IO

from drivers.logs.mcap_writer import LogWriter
from omnid.client import Robot
from omnid.formats.tum import tum_row
from omnid.monitor.robot_state import ReceivedMessage
from omnid.transport.bus import ros_name
from omnid.transport.decode import Pose
from omnid.transport.topics import SAID


class TumWriter:
    """Writes the poses of the base, a line each, as they come."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self._file: IO[str] | None = None
        self._newest_ns = -1

    def __call__(self, letter: ReceivedMessage, pose: Pose | None) -> None:
        """Adds a pose; one that is no later than the last is left out: a line for each moment."""
        if pose is None or pose.stamp_ns <= self._newest_ns:
            return
        if self._file is None:
            self._file = self._path.open("w", encoding="ascii")
        self._newest_ns = pose.stamp_ns
        self._file.write(f"{tum_row(pose.stamp_ns, pose.T_odom_base)}\n")

    def close(self) -> None:
        """Ends the file."""
        if self._file is not None:
            self._file.close()


class BusLogWriter:
    """Writes all messages to a log, with the robot's rig and configuration."""

    def __init__(self, path: Path, robot: Robot) -> None:
        self._robot = robot.name
        asked = {f"{file}.toml": robot.ask(name).encode() for file, name in (("rig", "rig"), ("omnid", "config"))}
        self._writer = LogWriter(path, {name: text for name, text in asked.items() if text})

    def __call__(self, letter: ReceivedMessage, _: Pose | None) -> None:
        """Adds a message under its name in ROS 2; its time is that of its arrival."""
        for name in (letter.topic, f"/{letter.topic}"):
            if name in SAID:
                self._writer.write(ros_name(self._robot, name), SAID[name].schema, letter.payload, letter.received_ns)

    def close(self) -> None:
        """Makes the file whole."""
        self._writer.close()
