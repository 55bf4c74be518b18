"""A trial: the robot drives, a fault comes, and the outcome is checked and described."""

from __future__ import annotations

import contextlib
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import NamedTuple

from tests.replay.live import Base, Daemon, Operator, robot, started
from tests.waiting import wait_until

WATCH_S = 1.5  # time in which stopped wheels must not turn
FAULTY_DAEMON = "tests.replay.faulty"


class Outcome(NamedTuple):
    """The outcome of a fault, for the table."""

    process: str
    wheels: str
    status: str


class Setting(NamedTuple):
    """A recorded scene, and a folder to use."""

    scene: Path
    folder: Path


Trial = Callable[[Setting], Outcome]
TRIALS: dict[str, Trial] = {}


def trial(name: str) -> Callable[[Trial], Trial]:
    """Register a trial in the table."""

    def enter(run: Trial) -> Trial:
        TRIALS[name] = run
        return run

    return enter


@contextlib.contextmanager
def driving(setting: Setting, *words: object, module: str = "omnid") -> Iterator[tuple[Daemon, Operator, Base]]:
    """Start a robot that drives; at the end its daemon must still run, and end with exit code 0."""
    with robot(setting.scene, setting.folder, *words, module=module) as (daemon, operator, base):
        operator.drive()
        wait_until(lambda: base.line.base.velocity_mps > 0.2, "motion")
        yield daemon, operator, base
        code, err = daemon.end()
        assert code == 0 and "Traceback" not in err, (code, err)
        assert not base.drives, "the wheels stop at the end"


def expect_stop(base: Base) -> None:
    """Wait until the wheels stop; they must not turn for WATCH_S after that."""
    wait_until(lambda: not base.drives, "the stop")
    wait_until(lambda: base.line.base.velocity_mps == 0, "standstill")
    since_s = time.monotonic()
    time.sleep(WATCH_S)
    assert not base.line.moved_since(since_s), "the wheels moved without a setpoint"


def expect_motion(base: Base) -> None:
    """Wait until the wheels turn."""
    wait_until(lambda: base.line.base.velocity_mps > 0.2, "motion again")


def ended(command: list[str]) -> tuple[int, str]:
    """Return exit code and stderr of a program that ends by itself."""
    with started(command, 0) as daemon:
        _, err = daemon.process.communicate(timeout=60)
        return daemon.process.returncode, err
