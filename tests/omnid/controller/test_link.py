"""The process that steers, seen from the daemon: a real one, on a twin behind a real pty."""

from __future__ import annotations

import contextlib
import math
import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from calib import se3
from drivers.errors import DriverError
from drivers.motor import VelocityCommand
from omnid.config import MotorConfig, RealtimeConfig
from omnid.controller.controller import ControllerSettings
from omnid.controller.link import ControllerLink, heading_of
from omnid.controller.messages import ControllerStart
from omnid.core.control import safety_rules as fail_safe
from omnid.core.control.heading_controller import Setpoint
from omnid.core.control.safety_rules import Deadlines
from omnid.core.control.velocity_limits import VelocityLimits
from omnid.engine.telemetry import StageStats
from omnid.errors import OmnidError
from omnid.messages import OdometryUpdate
from tests.replay.live import ROOT, Base, wait_until

DEADLINES = Deadlines(pose_s=5.0, command_s=5.0, tick_s=5.0)  # a busy machine is late with everything
AHEAD = Setpoint(0.4, None, 0.0)
DECELERATION_MPS2 = 0.8


def orders(port: object) -> ControllerStart:
    limits = VelocityLimits(deceleration_mps2=DECELERATION_MPS2)
    motor = MotorConfig(port=str(port), rate_hz=10.0, watchdog_ms=5000)
    return ControllerStart(motor, ControllerSettings(0.1, DEADLINES, limits=limits), RealtimeConfig(lock_memory=False))


def odometry(heading_rad: float = 0.0, rate_radps: float = 0.0) -> OdometryUpdate:
    T = se3.transform(se3.rotation_exp([0.0, 0.0, heading_rad]), [0.0, 0.0, 0.0])
    velocity = np.array([0.0, 0.0, 0.0, 0.0, 0.0, rate_radps])
    nothing_seen: Any = None
    return OdometryUpdate(
        0, time.monotonic_ns(), T, np.eye(6), velocity, np.eye(6), "tracking", 0, 99, 99, nothing_seen
    )


class Robot:
    """A link, and a thread that reads what the wheels are told."""

    def __init__(self, base: Base) -> None:
        self.base = base
        self.told: list[VelocityCommand] = []
        self.said: list[str] = []
        self.error: OmnidError | None = None
        self.stats = StageStats("motor")
        self.link = ControllerLink(orders(base.port), np.eye(4), self.stats, self.said.append)
        self._thread = threading.Thread(target=self._read)
        self._thread.start()

    @property
    def pid(self) -> int:
        return self.link._process.pid

    def drive(self) -> None:
        """Until it moves; asked again and again, for on a busy machine an answer may be late, which stops it."""
        wait_until(lambda: self._asked() and self.base.line.base.velocity_mps > 0.38, "motion")

    def _asked(self) -> bool:
        self.link.process(odometry())
        self.link.command(AHEAD, time.monotonic_ns())
        return True

    def joined(self) -> None:
        self._thread.join(20)
        assert not self._thread.is_alive()

    def _read(self) -> None:
        try:
            self.told.extend(self.link.told())
        except OmnidError as error:
            self.error = error


@pytest.fixture
def robot(tmp_path: Path) -> Iterator[Robot]:
    with contextlib.closing(Base(tmp_path)) as base:
        robot = Robot(base)
        try:
            yield robot
        finally:
            with contextlib.suppress(ProcessLookupError):
                os.kill(robot.pid, signal.SIGCONT)
            robot.link.end()
            robot.joined()
            robot.link.close()


def slowed_down(base: Base) -> None:
    """The wheels were told ever lower speeds, not to stand at once."""
    speeds = [note.wheels_mps[0] for note in base.line.notes]
    top = max(index for index, speed in enumerate(speeds) if speed == max(speeds))
    ramp = speeds[top:]
    assert ramp[-1] == 0.0 and len(set(ramp)) > 3 and all(a >= b for a, b in pairwise(ramp)), ramp


def test_poses_and_commands_turn_the_wheels_and_the_book_is_kept(robot: Robot) -> None:
    robot.drive()
    book = robot.link.logbook
    wait_until(lambda: book.account.sent > 5 and book.to_wheel.count >= 1, "an entry")
    assert robot.stats.processed > 5 and robot.stats.busy_since_ns > 0
    robot.link.stop()
    wait_until(lambda: not robot.base.drives, "the stop")
    wait_until(lambda: book.account.stops[fail_safe.ASKED] == 1, "its count")
    assert "the wheels stop: a stop was asked for" in robot.said
    robot.link.end()
    robot.joined()
    assert robot.told[-1].velocity_mps == 0.0 and max(command.velocity_mps for command in robot.told) > 0.38
    assert robot.error is None and robot.stats.busy_since_ns == 0


def test_at_the_end_the_wheels_slow_down(robot: Robot) -> None:
    robot.drive()
    robot.link.finish()
    robot.joined()
    robot.link.close()
    slowed_down(robot.base)
    assert robot.error is None and robot.link._process.returncode == 0


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT, signal.SIGHUP, signal.SIGABRT])
def test_signals_for_the_daemon_do_not_end_it(robot: Robot, number: int) -> None:
    robot.drive()
    os.kill(robot.pid, number)
    count = robot.link.logbook.account.sent
    wait_until(lambda: robot.link.logbook.account.sent > count + 5, "more ticks")


def test_a_process_that_is_killed_ends_the_run(robot: Robot) -> None:
    robot.drive()
    os.kill(robot.pid, signal.SIGKILL)
    robot.joined()
    assert robot.error is not None and "exit code -9" in str(robot.error) and "\n" not in str(robot.error)
    robot.link.stop()  # whoever does not know it yet
    robot.link.process(odometry())


def test_a_stop_arrives_though_the_line_was_full(robot: Robot) -> None:
    """The process gets no processor for a while; what is too much for the line is lost, a stop is not."""
    robot.drive()
    os.kill(robot.pid, signal.SIGSTOP)
    while not robot.link._line.lost:
        robot.link.command(AHEAD, time.monotonic_ns())
    robot.link.stop()
    assert robot.link._line.lost >= 2, "it went the way of the commands"
    os.kill(robot.pid, signal.SIGCONT)
    wait_until(lambda: robot.link._line.lost and _says_pose(robot), "the line's room")
    wait_until(lambda: not robot.base.drives, "the stop")
    assert robot.link.logbook.account.stops[fail_safe.ASKED] == 1


def _says_pose(robot: Robot) -> bool:
    """Whether a pose went through."""
    lost = robot.link._line.lost
    robot.link.process(odometry())
    return robot.link._line.lost == lost


OWNER = """
import sys, time
from tests.omnid.controller.test_link import AHEAD, ControllerLink, StageStats, np, odometry, orders
link = ControllerLink(orders(sys.argv[1]), np.eye(4), StageStats("motor"), print)
while True:
    link.process(odometry())
    link.command(AHEAD, time.monotonic_ns())
    time.sleep(0.05)
"""


def test_when_the_daemon_is_killed_the_wheels_slow_down(tmp_path: Path) -> None:
    with contextlib.closing(Base(tmp_path)) as base:
        command = [sys.executable, "-c", OWNER, str(base.port)]
        with subprocess.Popen(command, cwd=ROOT, env=os.environ | {"PYTHONPATH": str(ROOT)}) as owner:
            wait_until(lambda: base.line.base.velocity_mps > 0.38 or owner.poll() is not None, "motion")
            owner.kill()
        wait_until(lambda: not base.drives and base.line.notes[-1].wheels_mps == (0.0, 0.0), "the stand")
        slowed_down(base)
        assert not base.twin.watchdog_expired, "the process did it, not the controller"
        wait_until(lambda: not _has_open(base), "the end of the process")


def _has_open(base: Base) -> bool:
    """Whether some other process holds the controller's port."""
    port = base.port.resolve()
    for folder in Path("/proc").glob("[0-9]*/fd"):
        if folder.parent.name != str(os.getpid()):
            with contextlib.suppress(OSError):
                if any(os.readlink(entry) == str(port) for entry in folder.iterdir()):
                    return True
    return False


def test_a_process_that_is_stuck_is_killed_at_the_end(robot: Robot, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("omnid.controller.link.END_S", 0.5)
    os.kill(robot.pid, signal.SIGSTOP)
    robot.link.end()
    robot.joined()
    robot.link.close()
    assert robot.link._process.returncode == -signal.SIGKILL and robot.error is None


def test_a_port_that_is_not_there_gives_the_drivers_own_line() -> None:
    with pytest.raises(DriverError, match=r"motor port '/dev/nothing'.*there is no such port"):
        ControllerLink(orders("/dev/nothing"), np.eye(4), StageStats("motor"), print)


@pytest.mark.parametrize("odd", [{"heading_rad": math.nan}, {"rate_radps": math.nan}])
def test_a_pose_that_is_no_number_is_lost(odd: dict[str, float]) -> None:
    assert heading_of(odometry(), np.eye(4)).state == "tracking"
    assert heading_of(odometry(**odd), np.eye(4)).state == "lost"


def test_the_pose_of_the_wheels_is_that_of_the_base() -> None:
    T_base_rig = se3.transform(se3.rotation_exp([0.0, 0.0, 0.5]), [0.1, 0.0, 0.3])
    heading = heading_of(odometry(0.2, 0.3), T_base_rig)
    assert heading.heading_rad == pytest.approx(0.2) and heading.yaw_rate_radps == pytest.approx(0.3)
