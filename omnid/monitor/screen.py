"""A robot's state in the terminal."""

from __future__ import annotations

import math
import sys
from collections.abc import Iterator
from typing import IO, Final

import numpy as np

from omnid.monitor.robot_state import RobotState, plain
from omnid.transport.decode import Pose
from omnid.transport.status_names import short_name

_LEVELS: Final = ("", "warning", "ERROR", "stale")
_CLEAR: Final = "\x1b[H\x1b[J"


class Screen:
    """Output of the state: a table in place on a terminal, else one line per call."""

    def __init__(self, robot: str, out: IO[str] | None = None) -> None:
        self._robot, self._out = robot, out or sys.stdout
        self._last_reason = ""

    def waiting(self, reason: str) -> None:
        """Print why there is no connection yet, unless that was the last reason printed."""
        if reason != self._last_reason:
            print(f"omnid: waiting: {reason}", file=sys.stderr, flush=True)
        self._last_reason = reason

    def show(self, state: RobotState, dropped: int = 0) -> None:
        """Write the state; dropped: messages that the inbox could not hold."""
        if self._out.isatty():
            self._out.write(_CLEAR + "\n".join(status_table(self._robot, state, dropped)) + "\n")
        else:
            self._out.write(summary_line(self._robot, state) + "\n")
        self._out.flush()


def summary_line(robot: str, state: RobotState) -> str:
    """Return pose, rate, losses and latencies in one line."""
    if state.pose is None:
        return f"{robot}: no pose yet"
    counts = f"{state.rate_hz:.1f} Hz  missed {state.missed}"
    return f"{robot}: {state.state}  {_position(state.pose)}  {counts}  {_latencies(state)}"


def status_table(robot: str, state: RobotState, dropped: int) -> Iterator[str]:
    """Yield the same line, the uncertainty of the pose, and a line for each part of the robot."""
    yield summary_line(robot, state)
    if state.pose is not None:
        sigma = np.sqrt(np.maximum(0.0, state.pose.covariance.diagonal()))
        details = state.pose.attachment
        yield (f"  1 sigma {1e3 * sigma[:3].max():.1f} mm, {math.degrees(sigma[3:].max()):.3f} deg; "
               f"inliers {details.inliers} of {details.tracked} landmarks; resets {details.resets}; "
               f"unreadable {state.broken}, dropped {dropped}")
    for status in state.statuses.values():
        values = "  ".join(f"{key} {value}" for key, value in status.values.items())
        yield plain(f"  {_LEVELS[status.level % 4]:7s} {short_name(status.name):16s} {status.message}  {values}")


def _position(pose: Pose) -> str:
    yaw_deg = math.degrees(pose.yaw_rad)
    return f"x {pose.x_m:+.3f} y {pose.y_m:+.3f} z {pose.z_m:+.3f} m  yaw {yaw_deg:+.2f} deg"


def _latencies(state: RobotState) -> str:
    """Return ages and network latencies in ms, median and 99th percentile."""
    named = (("age", state.age), ("network", state.network))
    return "  ".join(f"{name} {1e3 * times_s.p(0.5):.1f}/{1e3 * times_s.p(0.99):.1f} ms" for name, times_s in named
                     if times_s.count)
