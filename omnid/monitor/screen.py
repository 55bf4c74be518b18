"""A robot's state in the terminal."""

from __future__ import annotations

import math
import shutil
import sys
from collections.abc import Iterable, Iterator
from typing import IO, Final

import numpy as np

from omnid.monitor.robot_state import RobotState
from omnid.plain_text import plain
from omnid.transport.decode import Pose
from omnid.transport.records import DiagnosticStatus
from omnid.transport.status_names import STAGE_PREFIX, THREADS, Key, number, short_name

_LEVELS: Final = ("", "warning", "ERROR", "stale")
LARGEST: Final = 5  # shares of threads in one line
CLEAR: Final = "\x1b[H\x1b[J"


class Screen:
    """Output of the state: a table in place on a terminal, else one line per call."""

    def __init__(self, robot: str, out: IO[str] | None = None, *, shows_load: bool = False) -> None:
        """shows_load: the share of each thread, in place of the state."""
        self._robot, self._out = robot, out or sys.stdout
        self._line, self._table = (load_line, load_table) if shows_load else (summary_line, status_table)

    def show(self, state: RobotState, dropped: int = 0) -> None:
        """Write the state; dropped: messages that the inbox could not hold."""
        if self._out.isatty():
            size = shutil.get_terminal_size()
            lines = fitted(self._table(self._robot, state, dropped), size.columns, size.lines)
            self._out.write(CLEAR + "\n".join(lines) + "\n")
        else:
            self._out.write(self._line(self._robot, state) + "\n")
        self._out.flush()


def summary_line(robot: str, state: RobotState) -> str:
    """Return pose, rate, losses and latencies in one line."""
    if state.pose is None:
        return f"{robot}: {state.state}"
    counts = f"{state.rate_hz:.1f} Hz  missed {state.missed}"
    return f"{robot}: {state.state}  {_position(state.pose)}  {counts}  {_latencies(state)}"


def status_table(robot: str, state: RobotState, dropped: int) -> Iterator[str]:
    """Yield the state, the pose with its uncertainty, latencies, and a line for each part of the robot.

    Parts with a warning or an error come first, stages last: a small terminal shows what matters.
    """
    rate = "" if state.pose is None else f"  {state.rate_hz:.1f} poses/s"
    yield f"{robot}: {state.state}{rate}"
    if state.pose is not None:
        sigma = np.sqrt(np.maximum(0.0, state.pose.covariance.diagonal()))
        details = state.pose.attachment
        yield f"  {_position(state.pose)}"
        yield (
            f"  1 sigma {1e3 * sigma[:3].max():.1f} mm, {math.degrees(sigma[3:].max()):.3f} deg; "
            f"inliers {details.inliers} of {details.tracked}; resets {details.resets}"
        )
        yield f"  {_latencies(state)}  missed {state.missed}  unreadable {state.broken}  not shown here {dropped}"
    for status in sorted(state.statuses.values(), key=importance):
        values = "  ".join(f"{key} {value}" for key, value in status.values.items())
        yield plain(f"  {_LEVELS[status.level % 4]:7s} {short_name(status.name):16s} {status.message}  {values}")


def load_table(robot: str, state: RobotState, dropped: int = 0) -> Iterator[str]:
    """Yield the share of a core that all threads take, and that of each, the largest first."""
    shares = dict(thread_shares(state))
    if not shares:
        yield f"{robot}: no load of its threads yet"
        return
    yield f"{robot}: {_percent(shares.pop(Key.ALL, math.nan))} of a core"
    for name, share in sorted(shares.items(), key=lambda entry: -entry[1]):
        yield plain(f"  {_percent(share):>7s}  {name}")


def load_line(robot: str, state: RobotState) -> str:
    """Return the share of a core that all threads take, and those of the largest, in one line."""
    head, *rows = load_table(robot, state)
    return ", ".join([head, *(" ".join(row.split()) for row in rows[:LARGEST])])


def thread_shares(state: RobotState) -> Iterator[tuple[str, float]]:
    """Yield names and shares of a core that the robot has reported; all together under Key.ALL."""
    if (status := state.statuses.get(THREADS)) is not None:
        for name, text in status.values.items():
            if (share := number(text)) is not None:
                yield name, share


def _percent(share: float) -> str:
    return f"{100 * share:.1f} %"


def fitted(lines: Iterable[str], columns: int, rows: int) -> list[str]:
    """Return the lines cut to the columns and rows of a terminal; its last row is for the cursor."""
    cut = [line if len(line) <= columns else f"{line[: max(0, columns - 1)]}\N{HORIZONTAL ELLIPSIS}" for line in lines]
    if len(cut) < rows:
        return cut
    shown = max(1, rows - 2)
    return [*cut[:shown], f"  ... {len(cut) - shown} more; make the window higher"[:columns]]


def importance(status: DiagnosticStatus) -> tuple[int, bool, str]:
    """Return a key by which entries are sorted: the worst first, stages last, then by name."""
    return -(status.level % 4), status.name.startswith(STAGE_PREFIX), status.name


def _position(pose: Pose) -> str:
    yaw_deg = math.degrees(pose.yaw_rad)
    return f"x {pose.x_m:+.3f} y {pose.y_m:+.3f} z {pose.z_m:+.3f} m  yaw {yaw_deg:+.2f} deg"


def _latencies(state: RobotState) -> str:
    """Return ages and network latencies in ms, median and 99th percentile; the pace of a simulation."""
    pace = [f"{plain(state.real_time_factor)} x real time"] if state.real_time_factor else []
    named = (("age", state.age), ("network", state.network))
    times = [
        f"{name} {1e3 * times_s.p(0.5):.1f}/{1e3 * times_s.p(0.99):.1f} ms" for name, times_s in named if times_s.count
    ]
    return "  ".join([*pace, *times])
