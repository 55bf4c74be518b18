"""Times from a cause to wheels at rest, judged at the motor controller's side of the serial line.

Each stop begins at full motion and at a random moment of the period of images and commands, which go on. When a cause
that disarms has ended, nothing may move before cmd/arm. Causes that end the daemon start it again for each stop.
"""

from __future__ import annotations

import os
import random
import signal
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Final, NamedTuple

import numpy as np

from tests.bench.results import Column, ResultTable
from tests.replay.live import Base, Daemon, Operator, robot
from tests.waiting import wait_until

FAULTY_DAEMON: Final = "tests.replay.faulty"
SPEED_MPS: Final = 0.3
POLL_S: Final = 0.002
STILL_S: Final = 0.3  # wheels at rest must stay there for so long, while the cause lasts and after it
ARM_PERIOD_S: Final = 0.2
MANUAL: Final = ("--set", "controller.arming=manual")
COLUMNS: Final = (
    Column("cause"),
    Column("stops"),
    Column("last command to move, p50", "ms", 0),
    Column("p99", "ms", 0),
    Column("max", "ms", 0),
    Column("at rest, p50", "ms", 0),
    Column("p99", "ms", 0),
    Column("max", "ms", 0),
)
PHASE_S: Final = 0.2  # span of the random moments


class Robot(NamedTuple):
    """A daemon that drives, its operator, and its base."""

    daemon: Daemon
    operator: Operator
    base: Base


class StopTime(NamedTuple):
    """Times after a cause, s."""

    last_motion_s: float  # of the last command that turned a wheel; 0 if none came after the cause
    rest_s: float  # wheels at rest, as the simulated base moves


class Cause(NamedTuple):
    """A cause of a stop: `begin` brings it about, `end` undoes it where the daemon lives on."""

    begin: Callable[[Robot], None]
    end: Callable[[Robot], None] | None  # None: the robot does not survive it
    disarms: bool = True


def _nothing(_: Robot) -> None:
    """Undo nothing."""


def _signals(number: int, *, daemon: bool, controller: bool) -> Callable[[Robot], None]:
    """Return a function that sends a signal to the daemon, its controller process, or both."""

    def send(robot: Robot) -> None:
        controller_pid = robot.daemon.controller_pid
        if daemon:
            robot.daemon.process.send_signal(number)
        if controller:
            os.kill(controller_pid, number)

    return send


def _hears_nothing(deaf: bool) -> Callable[[Robot], None]:
    def set_fault(robot: Robot) -> None:
        robot.base.twin.drop_input = deaf

    return set_fault


def _images(line: str) -> Callable[[Robot], None]:
    return lambda robot: robot.daemon.write_line(line)


CAUSES: Final[dict[str, Cause]] = {
    "cmd/stop, the operator goes on sending": Cause(lambda robot: robot.operator.send("cmd/stop", b""), _nothing),
    "the operator sends no more": Cause(lambda robot: robot.operator.stop_sending(), _nothing, disarms=False),
    "the operator leaves the bus": Cause(lambda robot: robot.operator.close(), None),
    "no images of one camera": Cause(_images("upper mute"), _images("both ok")),
    "no images at all": Cause(_images("both mute"), _images("both ok")),
    "images frozen": Cause(_images("both frozen"), _images("both ok")),
    "darkness": Cause(_images("both black"), _images("both ok")),
    "the daemon does not run (SIGSTOP)": Cause(
        _signals(signal.SIGSTOP, daemon=True, controller=False), _signals(signal.SIGCONT, daemon=True, controller=False)
    ),
    "nothing of it runs (SIGSTOP)": Cause(
        _signals(signal.SIGSTOP, daemon=True, controller=True), _signals(signal.SIGCONT, daemon=True, controller=True)
    ),
    "the motor controller hears nothing": Cause(_hears_nothing(True), _hears_nothing(False)),
    "SIGTERM": Cause(_signals(signal.SIGTERM, daemon=True, controller=False), None),
    "the daemon killed (SIGKILL)": Cause(_signals(signal.SIGKILL, daemon=True, controller=False), None),
    "its controller process killed": Cause(_signals(signal.SIGKILL, daemon=False, controller=True), None),
}


def begin_motion(robot: Robot) -> None:
    """Have the operator drive, and arm until the wheels have reached the speed."""
    base = robot.base
    robot.operator.drive(SPEED_MPS)

    def moves() -> bool:
        if not base.drives:
            robot.operator.arm()
            time.sleep(ARM_PERIOD_S)
        return base.line.base.velocity_mps > 0.9 * SPEED_MPS

    wait_until(moves, "motion")


def measured(robot: Robot, cause: Cause, rng: random.Random, begin: Callable[[Robot], None] = begin_motion) -> StopTime:
    """Drive, bring the cause about, and return the times until the wheels rest."""
    base = robot.base
    begin(robot)
    time.sleep(rng.uniform(0.0, PHASE_S))
    begin_s = time.monotonic()
    cause.begin(robot)
    while base.line.base.velocity_mps or base.line.base.yaw_rate_radps or base.drives:
        assert time.monotonic() < begin_s + 20, "the wheels did not come to rest"
        time.sleep(POLL_S)
    rest_s = time.monotonic()
    time.sleep(STILL_S)
    assert not base.line.moved_since(rest_s), "the wheels turned again while the cause lasted"
    moving = [note.at_s for note in list(base.line.notes) if note.at_s > begin_s and any(note.wheels_mps)]
    return StopTime(moving[-1] - begin_s if moving else 0.0, rest_s - begin_s)


def end_cause(robot: Robot, cause: Cause) -> None:
    """Undo a cause; nothing may move for STILL_S although the operator sends, unless the cause does not disarm."""
    assert cause.end is not None
    since_s = time.monotonic()
    cause.end(robot)
    time.sleep(STILL_S)
    assert not cause.disarms or not robot.base.line.moved_since(since_s), "the wheels turned again without cmd/arm"


def stop_times(recorded: Path, folder: Path, name: str, count: int, seed: int) -> list[StopTime]:
    """Return the times of so many stops by one cause."""
    rng, cause, times = random.Random(f"{seed} {name}"), CAUSES[name], []
    if cause.end is None:
        for number in range(count):
            with started(recorded, folder / f"{number}") as one:
                times.append(measured(one, cause, rng))
        return times
    with started(recorded, folder / "0") as one:
        for _ in range(count):
            times.append(measured(one, cause, rng))
            end_cause(one, cause)
    return times


@contextmanager
def started(recorded: Path, folder: Path) -> Iterator[Robot]:
    """Yield a robot that needs cmd/arm."""
    folder.mkdir(parents=True)
    with robot(recorded, folder, *MANUAL, module=FAULTY_DAEMON) as parts:
        yield Robot(*parts)


def cells(name: str, times: list[StopTime]) -> list[Any]:
    """Return the row of a table, in ms."""
    figures = [
        value
        for column in zip(*times, strict=True)
        for value in (*np.percentile(1000 * np.array(column), (50, 99)), 1000 * max(column))
    ]
    return [name, len(times), *figures]


def failed_cells(name: str, error: AssertionError) -> list[Any]:
    """Return the row of a cause that did not stop the wheels."""
    return [f"{name}, FAILED: {' '.join(str(error).split())[:200]}", None, *[None] * 6]


def run(recorded: Path, folder: Path, words: list[str], count: int, seed: int) -> int:
    """Measure a row for each cause whose name has one of the words; return the number of causes that did not stop."""
    table = ResultTable("faults_stops", "From a cause to wheels at rest", COLUMNS)
    failed = 0
    for number, name in enumerate(name for name in CAUSES if not words or any(word in name for word in words)):
        try:
            table.add(*cells(name, stop_times(recorded, folder / f"stop-{number}", name, count, seed)))
        except AssertionError as error:
            failed += 1
            table.add(*failed_cells(name, error))
    return failed
