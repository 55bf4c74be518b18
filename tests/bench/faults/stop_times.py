"""Times from a cause to wheels at rest, judged at the motor controller's side of the serial line.

Each stop begins at full motion and at a random moment of the period of images and commands, which go on. When a cause
that disarms has ended, nothing may move before cmd/arm. Causes that end the daemon start it again for each stop.
"""

from __future__ import annotations

import os
import random
import signal
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Final, Literal, NamedTuple

import numpy as np

from tests.bench.results import ResultTable, columns
from tests.replay.live import Base, Daemon, Operator, robot
from tests.waiting import wait_until

FAULTY_DAEMON: Final = "tests.replay.faulty"
SPEED_MPS: Final = 0.3
POLL_S: Final = 0.002
STILL_S: Final = 0.3  # wheels at rest must stay there for so long, while the cause lasts and after it
ARM_PERIOD_S: Final = 0.2
MANUAL: Final = ("--set", "controller.arming=manual")
COLUMNS: Final = columns(
    *("cause", "stops", "last command to move, p50|ms|0", "p99|ms|0", "max|ms|0"),
    *("at rest, p50|ms|0", "p99|ms|0", "max|ms|0"),
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
    status: tuple[str, str] | None = None  # part of the daemon that names the cause, and how


def _nothing(_: Robot) -> None:
    """Undo nothing."""


def _signals(number: int, *processes: Literal["daemon", "controller"]) -> Callable[[Robot], None]:
    """Return a function that sends a signal to the daemon, its controller process, or both."""

    def send(robot: Robot) -> None:
        pids = {"daemon": robot.daemon.process.pid, "controller": robot.daemon.controller_pid}
        for name in processes:
            os.kill(pids[name], number)

    return send


def _hears_nothing(deaf: bool) -> Callable[[Robot], None]:
    return lambda robot: setattr(robot.base.twin, "drop_input", deaf)


def _images(line: str, part: str, word: str) -> Cause:
    """Return a fault of cameras; both are faultless again afterwards."""
    begin, end = (lambda robot, line=each: robot.daemon.write_line(line) for each in (line, "both ok"))
    return Cause(begin, end, status=(part, word))


CAUSES: Final[dict[str, Cause]] = {
    "cmd/stop, the operator goes on sending": Cause(lambda robot: robot.operator.send("cmd/stop", b""), _nothing),
    "the operator sends no more": Cause(lambda robot: robot.operator.stop_sending(), _nothing, disarms=False),
    "the operator leaves the bus": Cause(lambda robot: robot.operator.close(), None),
    "no images of one camera": _images("upper mute", "pairing", "no images of the upper camera"),
    "no images at all": _images("both mute", "pairing", "no images of the lower and the upper camera"),
    "images that cannot be decoded": _images("lower garbage", "pairing", "cannot be decoded"),
    "images that are cut": _images("both cut", "pairing", "cannot be decoded"),
    "images of one camera frozen": _images("upper frozen", "pairing", "images of the upper camera are frozen"),
    "images frozen": _images("both frozen", "pairing", "images of the lower and the upper camera are frozen"),
    "darkness": _images("both black", "odometry", "lost"),
    "the daemon does not run (SIGSTOP)": Cause(_signals(signal.SIGSTOP, "daemon"), _signals(signal.SIGCONT, "daemon")),
    "nothing of it runs (SIGSTOP)": Cause(
        _signals(signal.SIGSTOP, "daemon", "controller"), _signals(signal.SIGCONT, "daemon", "controller")
    ),
    "the motor controller hears nothing": Cause(_hears_nothing(True), _hears_nothing(False)),
    "SIGTERM": Cause(_signals(signal.SIGTERM, "daemon"), None),
    "the daemon killed (SIGKILL)": Cause(_signals(signal.SIGKILL, "daemon"), None),
    "its controller process killed": Cause(_signals(signal.SIGKILL, "controller"), None),
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
    if cause.status is not None:
        part, word = cause.status
        wait_until(lambda: word in robot.operator.message(part), f"'{word}'")
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


def run(recorded: Path, folder: Path, words: Sequence[str], count: int, seed: int) -> int:
    """Measure a row [ms] for each cause whose name has one of the words; return the number that did not stop."""
    table, failed = ResultTable("faults_stops", "From a cause to wheels at rest", COLUMNS), 0
    for number, name in enumerate(name for name in CAUSES if not words or any(word in name for word in words)):
        try:
            times = 1e3 * np.array(stop_times(recorded, folder / f"stop-{number}", name, count, seed))
            table.add(name, count, *np.percentile(times, (50, 99, 100), axis=0).T.ravel())
        except AssertionError as error:
            failed += 1
            table.add(f"{name}, FAILED: {' '.join(str(error).split())[:200]}", None, *[None] * 6)
    return failed
