"""A robot in the terminal."""

from __future__ import annotations

import math
import sys
from collections.abc import Iterator
from typing import IO, Final

import numpy as np

from omnid.monitor.robot_state import RobotState, plain
from omnid.transport.decode import Pose

_LEVELS: Final = ("", "warning", "ERROR", "stale")
_CLEAR: Final = "\x1b[H\x1b[J"


class Screen:
    """Where it is shown: a terminal gets a table in place, all else a line a second."""

    def __init__(self, robot: str, out: IO[str] | None = None) -> None:
        self._robot, self._out = robot, out or sys.stdout
        self._said = ""

    def say(self, text: str) -> None:
        """Tells once what keeps us waiting."""
        if text != self._said:
            print(f"omnid: waiting: {text}", file=sys.stderr, flush=True)
        self._said = text

    def show(self, heard: RobotState, forgotten: int = 0) -> None:
        """The state of things now."""
        if self._out.isatty():
            self._out.write(_CLEAR + "\n".join(table(self._robot, heard, forgotten)) + "\n")
        else:
            self._out.write(line(self._robot, heard) + "\n")
        self._out.flush()


def line(robot: str, heard: RobotState) -> str:
    """All that matters in one line."""
    if heard.pose is None:
        return f"{robot}: no pose yet"
    counts = f"{heard.rate_hz:.1f} Hz  missed {heard.missed}"
    return f"{robot}: {heard.state}  {_where(heard.pose)}  {counts}  {_times(heard)}"


def table(robot: str, heard: RobotState, forgotten: int) -> Iterator[str]:
    """The same, and what the parts of the robot say of themselves."""
    yield line(robot, heard)
    if heard.pose is not None:
        deviation = np.sqrt(np.maximum(0.0, heard.pose.covariance.diagonal()))
        yield (f"  1 sigma {1e3 * deviation[:3].max():.1f} mm, {math.degrees(deviation[3:].max()):.3f} deg; "
               f"{heard.pose.note.inliers} of {heard.pose.note.tracks} landmarks; resets {heard.pose.note.resets}; "
               f"unreadable {heard.broken}, forgotten {forgotten}")
    for status in heard.statuses.values():
        values = "  ".join(f"{key} {value}" for key, value in status.values.items())
        name = status.name.removeprefix("omnid: ")
        yield plain(f"  {_LEVELS[status.level % 4]:7s} {name:16s} {status.message}  {values}")


def _where(pose: Pose) -> str:
    yaw_deg = math.degrees(pose.yaw_rad)
    return f"x {pose.x_m:+.3f} y {pose.y_m:+.3f} z {pose.z_m:+.3f} m  yaw {yaw_deg:+.2f} deg"


def _times(heard: RobotState) -> str:
    """Ages and latencies in ms, median and 99th percentile."""
    named = (("age", heard.age), ("way", heard.way))
    return "  ".join(f"{name} {1e3 * times.p(0.5):.1f}/{1e3 * times.p(0.99):.1f} ms" for name, times in named
                     if times.count)
