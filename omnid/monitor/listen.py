"""`omnid listen`: a robot's messages are counted and shown, until a signal or for a given time."""

from __future__ import annotations

import math
import shutil
import sys
import time
from collections.abc import Iterator
from contextlib import ExitStack
from typing import IO, Final

import numpy as np

from omnid.client import Robot
from omnid.engine.process import handle_stop_signals
from omnid.monitor.robot_state import LEVELS, RobotState, importance
from omnid.plain_text import plain
from omnid.transport.session import BusConfig, Unreachable
from omnid.transport.status_names import short_name

SHOW_PERIOD_S: Final = 1.0


def listen(bus: BusConfig, seconds: float | None) -> int:
    """Show the robot until a signal or for a number of seconds. Return the exit code, 1 where no pose arrived."""
    state, signals, reason = RobotState(), list[int](), ""
    robot: Robot | None = None
    end_s = math.inf if seconds is None else time.monotonic() + seconds
    with handle_stop_signals(lambda number, _: signals.append(number)), ExitStack() as connection:
        while not signals and time.monotonic() < end_s:
            # 1. Try to connect until it succeeds, and print each new reason once.
            if robot is None:
                try:
                    robot = connection.enter_context(Robot(settings=bus))
                except Unreachable as error:
                    if str(error) != reason:
                        print(f"omnid: waiting: {error}", file=sys.stderr, flush=True)
                    reason = str(error)
                    time.sleep(SHOW_PERIOD_S)
                    continue
                robot.on_message(state.put, "odom")
                robot.on_message(state.put, "status", kept=True)
                robot.on_alive(state.set_alive)
            # 2. Process messages for a period, and show the state.
            next_s = min(end_s, time.monotonic() + SHOW_PERIOD_S)
            while (left_s := next_s - time.monotonic()) > 0 and not signals:
                state.next(left_s)
            state.forget_ended()
            print_state(robot.name, state)
    return int(state.poses == 0)


def print_state(robot: str, state: RobotState, out: IO[str] | None = None) -> None:
    """Write a table in place on a terminal, as far as it fits, else one line."""
    out = out or sys.stdout
    if out.isatty():
        size = shutil.get_terminal_size()
        lines = [line[: size.columns] for line in status_table(robot, state)]
        out.write("\x1b[H\x1b[J" + "\n".join(lines[: size.lines - 1]) + "\n")
    else:
        out.write("  ".join(line.strip() for line in pose_lines(robot, state)) + "\n")
    out.flush()


def pose_lines(robot: str, state: RobotState) -> Iterator[str]:
    """Yield the state, and where there is a pose its position, uncertainty, losses and latencies."""
    if state.pose is None:
        yield f"{robot}: {state.state}"
        return
    pose, details = state.pose, state.pose.attachment
    sigma = np.sqrt(np.maximum(0.0, pose.covariance.diagonal()))
    yield f"{robot}: {state.state}  {state.rate_hz:.1f} poses/s"
    yaw_deg = math.degrees(pose.yaw_rad)
    yield f"  x {pose.x_m:+.3f} y {pose.y_m:+.3f} z {pose.z_m:+.3f} m  yaw {yaw_deg:+.2f} deg"
    yield (
        f"  1 sigma {1e3 * sigma[:3].max():.1f} mm, {math.degrees(sigma[3:].max()):.3f} deg; "
        f"inliers {details.inliers} of {details.tracked}; resets {details.resets}"
    )
    # The pace of a simulation, and ages of poses, median and 99th percentile.
    pace = [f"{plain(state.real_time_factor)} x real time"] if state.real_time_factor else []
    age = [f"age {1e3 * state.age.p(0.5):.1f}/{1e3 * state.age.p(0.99):.1f} ms"] if state.age.count else []
    losses = f"missed {state.missed}  unreadable {state.broken}  not shown here {state.dropped}"
    yield "  " + "  ".join([*pace, *age, losses])


def status_table(robot: str, state: RobotState) -> Iterator[str]:
    """Yield the lines of the pose, and a line for each part of the robot.

    Parts with a warning or an error come first, stages last: a small terminal shows what matters.
    """
    yield from pose_lines(robot, state)
    for status in sorted(state.statuses.values(), key=importance):
        values = "  ".join(f"{key} {value}" for key, value in status.values.items())
        yield plain(
            f"  {LEVELS[status.level % len(LEVELS)]:7s} {short_name(status.name):16s} {status.message}  {values}"
        )
