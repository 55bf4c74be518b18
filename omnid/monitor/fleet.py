"""All robots that a router reaches, in one table."""

from __future__ import annotations

import math
import shutil
import sys
import time
from collections import deque
from collections.abc import Iterator, Mapping, Sequence
from typing import IO, Final

from omnid.client import Fleet
from omnid.engine.signals import handle_stop_signals
from omnid.errors import OmnidError
from omnid.monitor.connecting import connected_until
from omnid.monitor.follow import POLL_S, SHOW_PERIOD_S
from omnid.monitor.robot_state import Inbox, ReceivedMessage, RobotState
from omnid.monitor.screen import CLEAR, fitted
from omnid.plain_text import plain
from omnid.transport.bus_config import BusConfig
from omnid.transport.codec import OK
from omnid.transport.records import DiagnosticStatus
from omnid.transport.status_names import short_name

MAX_ROBOTS: Final = 500
_NAME_COLUMNS: Final = 20
FLEET_TOPICS: Final = ("odom", "status")
_POSE_HEAD: Final = f" {'x m':>9} {'y m':>9} {'yaw deg':>8} {'age ms':>7}"
NARROW_COLUMNS: Final = 110  # A terminal with fewer columns shows no positions, to leave room for what is wrong.


class FleetState:
    """The robots by name, at most MAX_ROBOTS; the names of others are counted."""

    def __init__(self) -> None:
        self.robots: dict[str, RobotState] = {}
        self.refused: set[str] = set()  # at most MAX_ROBOTS names
        self._alive: deque[tuple[str, bool]] = deque(maxlen=4 * MAX_ROBOTS)  # robots that came or went

    def process(self, message: ReceivedMessage) -> None:
        """Take a message whose topic is the whole key: the robot's name and the topic's."""
        name, _, topic = message.topic.rpartition("/")
        state = self.robot(name)
        if state is not None:
            state.process(message._replace(topic=topic))
            state.forget_ended()  # The message may have arrived after its daemon's end was noted.

    def note_alive(self, name: str, alive: bool) -> None:
        """Note that the daemon of a robot came or went, for `take_alive`; from any thread."""
        self._alive.append((name, alive))

    def take_alive(self) -> None:
        """Set which daemons are there, by what was noted since the last call."""
        while self._alive:
            name, alive = self._alive.popleft()
            state = self.robot(name)
            if state is not None:
                state.set_alive(alive)
                state.forget_ended()

    def robot(self, name: str) -> RobotState | None:
        """Return the state of a robot, which is new at its first message; None beyond the limit."""
        if name not in self.robots:
            if len(self.robots) >= MAX_ROBOTS:
                if len(self.refused) < MAX_ROBOTS:
                    self.refused.add(name)
                return None
            self.robots[name] = RobotState()
        return self.robots[name]


def listen_to_all(bus: BusConfig, seconds: float | None) -> int:
    """Show all robots until a signal or for a number of seconds. Return the exit code, 1 where there was none."""
    fleet, stream = FleetState(), sys.stdout
    end_s = math.inf if seconds is None else time.monotonic() + seconds
    signals: list[int] = []
    with handle_stop_signals(lambda number, _: signals.append(number)):
        connection = connected_until(end_s, lambda: Fleet(bus), signals)
        if connection is not None:
            with connection:
                _follow(connection, fleet, stream, end_s, signals)
    show(fleet, stream)
    return int(not fleet.robots)


def _follow(connection: Fleet, fleet: FleetState, stream: IO[str], end_s: float, signals: Sequence[int]) -> None:
    inbox = Inbox()
    connection.on_alive(fleet.note_alive)
    connection.on_message(inbox.put, FLEET_TOPICS)
    next_s = time.monotonic() + SHOW_PERIOD_S
    while not signals and (now_s := time.monotonic()) < end_s:
        fleet.take_alive()
        message = inbox.get(min(next_s - now_s, end_s - now_s, POLL_S))
        if message is not None:
            fleet.process(message)
        if time.monotonic() >= next_s:
            show(fleet, stream, inbox.dropped)
            next_s = max(next_s + SHOW_PERIOD_S, time.monotonic())


def show(fleet: FleetState, stream: IO[str], dropped: int = 0) -> None:
    """Write the table, in place on a terminal; dropped: messages that the inbox could not hold."""
    size = shutil.get_terminal_size()
    narrow = stream.isatty() and size.columns < NARROW_COLUMNS
    lines = list(fleet_table(fleet.robots, len(fleet.refused), dropped, narrow=narrow))
    if stream.isatty():
        stream.write(CLEAR + "\n".join(fitted(lines, size.columns, size.lines)) + "\n")
    else:
        stream.write("\n".join(lines) + "\n")
    stream.flush()


def fleet_table(
    robots: Mapping[str, RobotState], refused: int = 0, dropped: int = 0, *, narrow: bool = False
) -> Iterator[str]:
    """Yield a head and a line for each robot: those that are gone or have the worst state first.

    narrow: without positions and ages.
    """
    counts = [sum(1 for state in robots.values() if severity(state) >= level) for level in (0, 1, 2)]
    more = f"; {refused} more than {MAX_ROBOTS} are left out" if refused else ""
    lost = f"; {dropped} messages dropped" if dropped else ""
    yield f"{counts[0]} robots, {counts[1] - counts[2]} with warnings, {counts[2]} with errors or gone{more}{lost}"
    yield f"{'robot':{_NAME_COLUMNS}} {'state':10} {'Hz':>5}{'' if narrow else _POSE_HEAD}  worst"
    for name, state in sorted(robots.items(), key=lambda entry: (-severity(entry[1]), entry[0])):
        yield _line(name, state, narrow)


def severity(state: RobotState) -> int:
    """Return 2 for an error, a robot that is gone or without poses, 1 for a warning, else 0."""
    levels = [status.level % 4 for status in state.statuses.values()]
    if state.alive is False or state.rate_hz == 0.0 or any(level >= 2 for level in levels):
        return 2
    return int(any(levels))


def word_of(state: RobotState) -> str:
    """Return the state of a robot in one or two words."""
    if state.alive is False:
        return "gone"
    return "no pose" if state.rate_hz == 0.0 else state.state


def worst_part(state: RobotState) -> DiagnosticStatus | None:
    """Return the worst entry of the status; None where all are good."""
    worst = max(state.statuses.values(), key=lambda status: status.level % 4, default=None)
    return None if worst is None or worst.level % 4 == OK else worst


def _line(name: str, state: RobotState, narrow: bool) -> str:
    shown = plain(name)
    shown = shown if len(shown) <= _NAME_COLUMNS else f"{shown[: _NAME_COLUMNS - 1]}\N{HORIZONTAL ELLIPSIS}"
    word = word_of(state)
    pose, age = state.pose, f"{1e3 * state.age.p(0.5):7.0f}" if state.age.count else f"{'':7}"
    where = (
        f"{'':9} {'':9} {'':8}"
        if pose is None
        else f"{pose.x_m:+9.2f} {pose.y_m:+9.2f} {math.degrees(pose.yaw_rad):+8.1f}"
    )
    worst = worst_part(state)
    problem = "" if worst is None else f"{short_name(worst.name)}: {worst.message}"
    details = "" if narrow else f" {where} {age}"
    return plain(f"{shown:{_NAME_COLUMNS}} {word:10.10} {state.rate_hz:5.1f}{details}  {problem}")


def check_all(robot: str | None, files: Mapping[str, object]) -> None:
    """Raise OmnidError for options of one robot together with --all."""
    given = [name for name, value in {"--robot": robot, **files}.items() if value is not None]
    if given:
        raise OmnidError(f"--all shows every robot, so {given[0]} does not go with it: leave one of them out")
