"""`omnid listen`: a robot's messages are counted, shown and written to files, until a signal or for a given time."""

from __future__ import annotations

import math
import shutil
import sys
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import IO, Final, TypeAlias

import numpy as np

from drivers.logs.mcap_writer import LogWriter
from omnid.client import Robot
from omnid.engine.process import handle_stop_signals
from omnid.formats.tum import tum_row
from omnid.monitor.robot_state import Inbox, ReceivedMessage, RobotState, importance
from omnid.plain_text import plain
from omnid.sinks.files import check_outputs
from omnid.transport.bus_config import BusConfig
from omnid.transport.decode import Pose
from omnid.transport.session import Unreachable
from omnid.transport.status_names import THREADS, Key, number, short_name
from omnid.transport.topics import PUBLISHED, ros_name

SHOW_PERIOD_S: Final = 1.0
POLL_S: Final = 0.5  # between two checks for the end, and two attempts to connect
# Topics of which the newest message may have been sent before this program came: frames, map, path, status.
KEPT: Final = tuple(name.removeprefix("/") for name, topic in PUBLISHED.items() if topic.latched and not topic.realtime)
CLEAR: Final = "\x1b[H\x1b[J"
_LEVELS: Final = ("", "warning", "ERROR", "stale")

Writer: TypeAlias = Callable[[ReceivedMessage, Pose | None], None]


def listen(
    bus: BusConfig, tum: Path | None, mcap: Path | None, seconds: float | None, *, shows_load: bool = False
) -> int:
    """Show the robot until a signal or for a number of seconds. Return the exit code, 1 where no pose arrived.

    Ctrl-C, SIGTERM and a closed terminal leave whole files. shows_load: the share of each of its threads, in place of
    its state.
    """
    check_outputs([(name, path) for name, path in (("--tum", tum), ("--mcap", mcap)) if path is not None], [])
    state, inbox, signals = RobotState(), Inbox(), list[int]()
    end_s = math.inf if seconds is None else time.monotonic() + seconds

    def show() -> None:
        print_state(bus.robot, state, inbox.dropped, shows_load=shows_load)

    with handle_stop_signals(lambda number, _: signals.append(number)), ExitStack() as stack:
        robot = connected(bus, end_s, signals)
        if robot is not None:
            stack.enter_context(robot)
            writers = [_tum_writer(tum, stack)] if tum else []
            writers += [_mcap_writer(mcap, robot, stack)] if mcap else []
            follow(robot, state, inbox, writers, show, end_s, signals)
    show()
    return int(state.poses == 0)


def connected(bus: BusConfig, end_s: float, signals: Sequence[int]) -> Robot | None:
    """Try to connect until it succeeds, and print each new reason once; return None after end_s or a signal.

    end_s: by time.monotonic(). signals: numbers of the signals that came; a handler of the caller adds to it.
    """
    reason = ""
    while not signals and time.monotonic() < end_s:
        try:
            return Robot(settings=bus)
        except Unreachable as error:
            if str(error) != reason:
                print(f"omnid: waiting: {error}", file=sys.stderr, flush=True)
            reason = str(error)
        time.sleep(POLL_S)
    return None


def follow(
    robot: Robot,
    state: RobotState,
    inbox: Inbox,
    writers: Sequence[Writer],
    show: Callable[[], None],
    end_s: float,
    signals: Sequence[int],
) -> None:
    """Process the robot's messages until end_s, by time.monotonic(), or a signal."""
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
            for write in writers:
                write(message, pose)
        if time.monotonic() >= next_s:
            show()
            next_s = max(next_s + SHOW_PERIOD_S, time.monotonic())


def _tum_writer(path: Path, stack: ExitStack) -> Writer:
    """Return a writer of the poses of the base as they arrive; the file is made with the first."""
    files, newest_ns = list[IO[str]](), [-1]

    def write(_: ReceivedMessage, pose: Pose | None) -> None:
        if pose is None or pose.stamp_ns <= newest_ns[0]:
            return
        if not files:
            files.append(stack.enter_context(path.open("w", encoding="ascii", buffering=1)))  # a row at a time
        newest_ns[0] = pose.stamp_ns
        files[0].write(f"{tum_row(pose.stamp_ns, pose.T_odom_base)}\n")

    return write


def _mcap_writer(path: Path, robot: Robot, stack: ExitStack) -> Writer:
    """Return a writer of all messages, at their time of arrival; rig and configuration are attached."""
    files = {f"{file}.toml": robot.query(name).encode() for file, name in (("rig", "rig"), ("omnid", "config"))}
    log = LogWriter(path, {name: text for name, text in files.items() if text})
    stack.callback(log.close)

    def write(message: ReceivedMessage, _: Pose | None) -> None:
        for name in {message.topic, f"/{message.topic}"} & PUBLISHED.keys():
            log.write(ros_name(robot.name, name), PUBLISHED[name].schema, message.payload, message.received_ns)

    return write


def print_state(
    robot: str, state: RobotState, dropped: int, out: IO[str] | None = None, *, shows_load: bool = False
) -> None:
    """Write a table in place on a terminal, else one line. dropped: messages that the inbox could not hold."""
    out = out or sys.stdout
    if out.isatty():
        size = shutil.get_terminal_size()
        table = load_table(robot, state) if shows_load else status_table(robot, state, dropped)
        out.write(CLEAR + "\n".join(fitted(table, size.columns, size.lines)) + "\n")
    else:
        out.write((load_line(robot, state) if shows_load else summary_line(robot, state)) + "\n")
    out.flush()


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


def load_table(robot: str, state: RobotState) -> Iterator[str]:
    """Yield the share of a core that all threads take, and that of each, the largest first."""
    threads = state.statuses[THREADS].values if THREADS in state.statuses else {}
    shares = {name: share for name, text in threads.items() if (share := number(text)) is not None}
    if not shares:
        yield f"{robot}: no load of its threads yet"
        return
    yield f"{robot}: {100 * shares.pop(Key.ALL, math.nan):.1f} % of a core"
    for name, share in sorted(shares.items(), key=lambda entry: -entry[1]):
        yield plain(f"  {100 * share:5.1f} %  {name}")


def load_line(robot: str, state: RobotState) -> str:
    """Return the share of a core that all threads take, and those of the five largest, in one line."""
    head, *rows = load_table(robot, state)
    return ", ".join([head, *(" ".join(row.split()) for row in rows[:5])])


def fitted(lines: Iterable[str], columns: int, rows: int) -> list[str]:
    """Return the lines cut to the columns and rows of a terminal; its last row is for the cursor."""
    cut = [line if len(line) <= columns else f"{line[: max(0, columns - 1)]}\N{HORIZONTAL ELLIPSIS}" for line in lines]
    if len(cut) < rows:
        return cut
    shown = max(1, rows - 2)
    return [*cut[:shown], f"  ... {len(cut) - shown} more; make the window higher"[:columns]]


def _position(pose: Pose) -> str:
    yaw_deg = math.degrees(pose.yaw_rad)
    return f"x {pose.x_m:+.3f} y {pose.y_m:+.3f} z {pose.z_m:+.3f} m  yaw {yaw_deg:+.2f} deg"


def _latencies(state: RobotState) -> str:
    """Return ages and network latencies in ms, median and 99th percentile; the pace of a simulation."""
    pace = [f"{plain(state.real_time_factor)} x real time"] if state.real_time_factor else []
    named = (("age", state.age), ("network", state.network))
    times = [f"{name} {1e3 * t_s.p(0.5):.1f}/{1e3 * t_s.p(0.99):.1f} ms" for name, t_s in named if t_s.count]
    return "  ".join([*pace, *times])
