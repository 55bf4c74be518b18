"""The campaign in small, and faults of a live robot: its wheels stop, its daemon goes on or ends in order.

`python -m tests.bench.faults` runs the campaign in full. Other faults are in `tests/replay` (clocks, a motor that is
unplugged, taken ports) and in `tests/contract` (motor controllers and their line).
"""

from __future__ import annotations

import contextlib
import time
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import pytest

from omnid.core.control.motion_monitor import NOT_COMMANDED, NOT_SEEN
from omnid.transport.status_names import STOPPED_PREFIX
from tests.bench.faults import hostile_commands, stop_times
from tests.bench.faults.hostile_files import FORMATS, attack, short_run
from tests.bench.faults.stop_times import FAULTY_DAEMON
from tests.replay.live import Base, Daemon, Operator, patient, robot
from tests.waiting import wait_until


def test_mutated_files_give_a_result_or_one_line(tmp_path: Path) -> None:
    memory_mb, found = attack(",".join(FORMATS), short_run(tmp_path), 60, seed=7)
    assert found == [] and 0 < memory_mb < 400


@pytest.mark.hazard("H09")
@pytest.mark.slow
def test_mutated_commands_never_move_the_wheels(tmp_path: Path, course: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("OMNID_RESULTS", str(tmp_path / "results"))
    assert hostile_commands.run(course, tmp_path, 2000, 7) == 0


@pytest.mark.slow
@pytest.mark.parametrize("name", stop_times.CAUSES)
def test_the_wheels_come_to_rest(tmp_path: Path, course: Path, name: str) -> None:
    times = stop_times.stop_times(course, tmp_path / "stops", name, 2, seed=7)
    assert len(times) == 2


WATCH_S = 1.5  # time in which stopped wheels must not turn


class Setting(NamedTuple):
    """A recorded scene, and a folder to use."""

    scene: Path
    folder: Path


@pytest.fixture
def setting(course: Path, tmp_path: Path) -> Setting:
    (tmp_path / "in").mkdir()
    return Setting(course, tmp_path / "in")


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


@pytest.mark.slow
def test_images_of_another_drive_stop_the_wheels(setting: Setting) -> None:
    """The images go to and fro at 0.5 m/s, as if the lens saw a screen, while 0.3 m/s forwards are commanded."""
    words = patient("controller.motion.check=true")
    with driving(setting, *words, module=FAULTY_DAEMON) as (_, operator, base):
        counts = [f"{STOPPED_PREFIX}{reason}" for reason in (NOT_SEEN, NOT_COMMANDED)]
        wait_until(lambda: any(key in operator.values("wheels") for key in counts), "a stop for this reason")
        wait_until(lambda: not base.drives, "wheels that stop although commands arrive")
        operator.stop_sending()  # after two seconds at rest the base would try again
        expect_stop(base)
