"""What a trial is: the robot drives, a fault comes, and in the end it is told what became of it."""

from __future__ import annotations

import contextlib
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import NamedTuple

from tests.replay.live import Base, Daemon, Operator, robot, started, wait_until

WATCHED_S = 1.5  # for so long wheels are watched that must not turn
SPOILT = "tests.replay.faulty"


class Outcome(NamedTuple):
    """What became of a fault."""

    process: str
    wheels: str
    status: str


class Place(NamedTuple):
    """A recorded scene, and a folder to use."""

    scene: Path
    folder: Path


Trial = Callable[[Place], Outcome]
TRIALS: dict[str, Trial] = {}


def trial(name: str) -> Callable[[Trial], Trial]:
    """Enters a trial in the table."""

    def enter(run: Trial) -> Trial:
        TRIALS[name] = run
        return run

    return enter


@contextlib.contextmanager
def driving(place: Place, *words: object, module: str = "omnid") -> Iterator[tuple[Daemon, Operator, Base]]:
    """A robot that drives as its operator wants; at the end its daemon lives, and ends with 0."""
    with robot(place.scene, place.folder, *words, module=module) as (daemon, operator, base):
        operator.drive()
        wait_until(lambda: base.line.base.velocity_mps > 0.2, "motion")
        yield daemon, operator, base
        code, err = daemon.end()
        assert code == 0 and "Traceback" not in err, (code, err)
        assert not base.drives, "the wheels stand at the end"


def stands(base: Base) -> None:
    """The wheels come to a stand and stay so for a while."""
    wait_until(lambda: not base.drives, "the stop")
    wait_until(lambda: base.line.base.velocity_mps == 0, "the stand")
    since_s = time.monotonic()
    time.sleep(WATCHED_S)
    assert not base.line.moved_since(since_s), "the wheels moved unasked"


def goes_on(base: Base) -> None:
    """The wheels turn again."""
    wait_until(lambda: base.line.base.velocity_mps > 0.2, "motion again")


def ended(command: list[str]) -> tuple[int, str]:
    """Exit code and stderr of a program that ends by itself."""
    with started(command, 0) as daemon:
        _, err = daemon.process.communicate(timeout=60)
        return daemon.process.returncode, err
