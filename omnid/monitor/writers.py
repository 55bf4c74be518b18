"""Files of a robot's messages: its path in the TUM format, and a log of all messages."""

from __future__ import annotations

from pathlib import Path
from typing import IO

from drivers.logs.mcap_writer import LogWriter
from omnid.client import Robot
from omnid.formats.tum import tum_row
from omnid.monitor.robot_state import ReceivedMessage
from omnid.transport.decode import Pose
from omnid.transport.topics import PUBLISHED, ros_name


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
            self._file = self._path.open("w", encoding="ascii")
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
