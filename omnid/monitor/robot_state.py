"""The state of a robot as its messages show it: one inbox and one decoder for terminals, pages and viewers.

`omnid listen` counts and shows the messages of a robot, until a signal or for a given time.
"""

from __future__ import annotations

import math
import shutil
import sys
import time
from collections import deque
from collections.abc import Collection, Iterator
from contextlib import closing, nullcontext
from typing import Any, Final, NamedTuple

import numpy as np

from omnid.client import ANSWER_S, HERE, NavigationReport, Robot
from omnid.core.navigation.requests import NavigationState
from omnid.engine.process import handle_stop_signals
from omnid.errors import OmnidError
from omnid.plain_text import MAX_ENTRIES, plain
from omnid.transport.codec import Diagnostics, DiagnosticStatus, Pose
from omnid.transport.session import PERIOD_S, BusConfig
from omnid.transport.status_names import DISARMED_BY_STOP, SIMULATION, STAGE_PREFIX, TIMEOUT_S, WHEELS, Key, short_name
from omnid.transport.stop_datagram import STOPPED, StopSender
from omnid.transport.topics import PUBLISHED

LEVELS: Final = ("", "warning", "ERROR", "stale")  # of a status, by its number
_INBOX_DEPTH: Final = 2000
_RECENT: Final = 100  # poses

SILENCE_S: Final = ANSWER_S  # A robot that sends no report for this time counts as lost.
# Time between two stops over the bus, and until the first: a datagram without an answer by then is behind a router.
REPEAT_S: Final = 0.15


class ReceivedMessage(NamedTuple):
    """A message as it arrived."""

    topic: str
    payload: bytes
    attachment: bytes
    arrival_s: float  # by CLOCK_MONOTONIC


class RobotState:
    """Newest pose and status of one robot, and counters, in constant memory.

    Messages wait in an inbox, of which the oldest are dropped when it is full; of some topics only the newest waits.
    """

    def __init__(self, newest_only: Collection[str] = ()) -> None:
        """newest_only: the topics of which only the newest message waits, behind those of all others."""
        self._inbox: deque[ReceivedMessage] = deque(maxlen=_INBOX_DEPTH)
        self._newest: dict[str, ReceivedMessage] = {}
        self._newest_only = newest_only
        self.pose: Pose | None = None
        self.statuses: dict[str, DiagnosticStatus] = {}
        self.alive: bool | None = None  # the daemon's liveliness token; None while it is not known
        self.poses = self.missed = self.broken = 0
        self.recent: deque[Pose] = deque(maxlen=_RECENT)  # newest poses of the run: a scan arrives after its pose
        self._arrivals_s: deque[float] = deque(maxlen=_RECENT)

    def put(self, topic: str, payload: bytes, attachment: bytes) -> None:
        """Add a message that has just arrived, from any thread; does not block."""
        message = ReceivedMessage(topic, payload, attachment, time.monotonic())
        if topic in self._newest_only:
            self._newest[topic] = message
        else:
            self._inbox.append(message)

    @property
    def is_waiting(self) -> bool:
        """True if a message waits."""
        return bool(self._inbox or self._newest)

    def next(self, timeout_s: float) -> Any:
        """Process the oldest message that waits; return its content, None after the timeout or for unreadable bytes."""
        end_s = time.monotonic() + timeout_s
        while not self.is_waiting:
            if time.monotonic() >= end_s:
                return None
            time.sleep(PERIOD_S)
        return self.process(self._inbox.popleft() if self._inbox else self._newest.popitem()[1])

    def process(self, message: ReceivedMessage) -> Any:
        """Return the content of a message, whose pose or status is kept; None, and count it, where it is unreadable."""
        if message.topic not in PUBLISHED:
            return None
        try:
            content = PUBLISHED[message.topic].decode(message.payload, message.attachment)
        except OmnidError:
            self.broken += 1
            return None
        if isinstance(content, Pose):
            self._add_pose(content, message.arrival_s)
        elif isinstance(content, Diagnostics):
            self.add_diagnostics(content)
        return content

    def set_alive(self, alive: bool) -> None:
        """Keep whether the daemon's liveliness token is there; from any thread.

        The statuses of a daemon that has ended are forgotten: it may start again in another state.
        """
        self.alive = alive
        if not alive:
            self.statuses = {}

    def add_diagnostics(self, diagnostics: Diagnostics) -> None:
        """Keep the newest status of each part of the robot."""
        for status in diagnostics.statuses if self.alive is not False else ():
            if status.name in self.statuses or len(self.statuses) < MAX_ENTRIES:
                self.statuses[status.name] = status

    def _add_pose(self, pose: Pose, arrival_s: float) -> None:
        """Count a pose. Skipped sequence numbers of a run are missed poses."""
        if self.pose is not None and pose.attachment.run == self.pose.attachment.run:
            self.missed += max(0, pose.attachment.seq - self.pose.attachment.seq - 1)
        else:
            self.recent.clear()
        self.recent.append(pose)
        self.pose = pose
        self.poses += 1
        self._arrivals_s.append(arrival_s)

    @property
    def real_time_factor(self) -> str:
        """Simulated time over time on the wall; empty for a robot whose clock is that of its computer."""
        simulation = self.statuses.get(SIMULATION)
        return "" if simulation is None else simulation.values.get(Key.REAL_TIME_FACTOR, "")

    @property
    def time_since_pose_s(self) -> float:
        """Time since the newest pose arrived; inf before the first."""
        return time.monotonic() - self._arrivals_s[-1] if self._arrivals_s else math.inf

    @property
    def rate_hz(self) -> float:
        """Rate of the last poses; 0 where there are none."""
        if len(self._arrivals_s) < 2 or self.time_since_pose_s > TIMEOUT_S:
            return 0.0
        return (len(self._arrivals_s) - 1) / max(1e-6, self._arrivals_s[-1] - self._arrivals_s[0])

    @property
    def state(self) -> str:
        """Tracking state of the newest pose, or the time since it and whether the daemon is still there."""
        if self.pose is None:
            return "no pose yet: no robot of this name is there" if self.alive is None else "no pose yet"
        if self.time_since_pose_s > TIMEOUT_S:
            gone = ", its daemon has ended or cannot be reached" if self.alive is False else ""
            return f"no pose for {self.time_since_pose_s:.0f} s{gone}"
        return plain(self.pose.state)


def importance(status: DiagnosticStatus) -> tuple[int, bool, str]:
    """Return a key by which entries are sorted: the worst first, stages last, then by name."""
    return -(status.level % len(LEVELS)), status.name.startswith(STAGE_PREFIX), status.name


def listen(bus: BusConfig, seconds: float | None) -> int:
    """Show the robot until a signal or for a number of seconds. Return the exit code, 1 where no pose arrived.

    Raise Unreachable where no endpoint answers.
    """
    state, signals = RobotState(), list[int]()
    end_s = math.inf if seconds is None else time.monotonic() + seconds
    with handle_stop_signals(lambda number, _: signals.append(number)), Robot(settings=bus) as robot:
        robot.on_message(state.put, "odom")
        robot.on_message(state.put, "status", kept=True)
        robot.on_alive(state.set_alive)
        while not signals and time.monotonic() < end_s:
            # Process messages for a second, and show the state.
            next_s = min(end_s, time.monotonic() + 1.0)
            while (left_s := next_s - time.monotonic()) > 0 and not signals:
                state.next(left_s)
            print_state(robot.name, state)
    return int(state.poses == 0)


def print_state(robot: str, state: RobotState) -> None:
    """Write a table in place on a terminal, as far as it fits, else one line."""
    out = sys.stdout
    if out.isatty():
        size = shutil.get_terminal_size()
        lines = [line[: size.columns] for line in status_table(robot, state)]
        out.write("\x1b[H\x1b[J" + "\n".join(lines[: size.lines - 1]) + "\n")
    else:
        out.write("  ".join(line.strip() for line in pose_lines(robot, state)) + "\n")
    out.flush()


def pose_lines(robot: str, state: RobotState) -> Iterator[str]:
    """Yield the state, and where there is a pose its position, uncertainty and losses."""
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
    yield f"  missed {state.missed}  unreadable {state.broken}"


def status_table(robot: str, state: RobotState) -> Iterator[str]:
    """Yield the lines of the pose, and a line for each part of the robot.

    Parts with a warning or an error come first, stages last: a small terminal shows what matters.
    """
    yield from pose_lines(robot, state)
    for status in sorted(state.statuses.values(), key=importance):
        values = "  ".join(f"{key} {value}" for key, value in status.values.items())
        yield f"  {LEVELS[status.level % len(LEVELS)]:7s} {short_name(status.name):16s} {status.message}  {values}"


def reports_of(robot: Robot, command_ns: int) -> Iterator[NavigationReport]:
    """Yield the reports of the drive that a request with this stamp began, and last the one with which it ended.

    The last report is that of another request if that has replaced this one. Raise OmnidError if the robot sends none
    for SILENCE_S.
    """
    begun, deadline_s = False, time.monotonic() + SILENCE_S
    with robot.subscribe(NavigationReport) as reports:
        while (report := reports.wait(deadline_s - time.monotonic())) is not None:
            is_own = report.command_ns == command_ns
            if is_own:
                begun, deadline_s = True, time.monotonic() + SILENCE_S
            if begun:
                yield report
                if not is_own or NavigationState(report.state).is_end:
                    return
    raise OmnidError(
        f"{robot.name} has been silent for {SILENCE_S:g} s: look at it; if only the network between is gone, it drives "
        "on (`omnid stop`, `omnid listen`)"
    )


def stop(bus: BusConfig, connection: Robot | None = None) -> bool:
    """Repeat a stop until the robot's status confirms it; False if it has not within ANSWER_S.

    A datagram is tried first, because it needs no session of the bus. If the robot does not answer it, the stop goes
    over the bus: by the given connection, else by a new one. Raise OmnidError where the robot cannot be reached.
    """
    deadline_s = time.monotonic() + ANSWER_S
    with closing(StopSender(bus.robot, bus.connect or (HERE,))) as datagrams:
        if datagrams.ask(REPEAT_S):
            return datagrams.ask(deadline_s - time.monotonic()) == STOPPED
        with (
            nullcontext(connection) if connection else Robot(settings=bus) as robot,
            robot.subscribe(Diagnostics) as statuses,
        ):
            driver = robot.driver()
            driver.require_connected()
            statuses.newest()  # Discard the status that the bus has kept: it is from before this stop.
            while time.monotonic() < deadline_s:
                driver.stop()
                report = statuses.wait(REPEAT_S)
                if report is not None and report.value(WHEELS, Key.DISARMED_BY) == DISARMED_BY_STOP:
                    return True
                if datagrams.ask(0.0) == STOPPED:
                    return True
    return False
