"""Obstacle rings at a real controller process, with a simulated motor behind a real pty: what the wheels do."""

from __future__ import annotations

import contextlib
import math
import threading
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from omnid.controller.link import ControllerLink
from omnid.core.control.collision_monitor import BLOCKED, REMEDY, RING_STALE, CollisionSettings, ControllerRing
from omnid.core.control.command_sources import TimedSetpoint
from omnid.core.control.control_law import ControllerSettings
from omnid.core.control.heading_controller import Setpoint
from omnid.engine.telemetry import StageStats
from tests.omnid.controller.test_link import DEADLINES, pose, start_message
from tests.replay.live import Base
from tests.waiting import wait_until

pytestmark = pytest.mark.usefixtures("default_signals")
FREE = (math.inf,) * 360
WALL = tuple(0.38 if 150 <= k < 210 else math.inf for k in range(360))  # ahead, in the stop polygon


class RobotWithRings:
    """A link to which poses, setpoints and rings are sent."""

    def __init__(self, base: Base) -> None:
        self.base = base
        self.lines: list[str] = []
        start = start_message(base.port)
        settings = ControllerSettings(
            DEADLINES, start.controller.limits, arming=start.controller.arming, collision=CollisionSettings(stale_s=2.0)
        )
        self.link = ControllerLink(start._replace(controller=settings), StageStats("motor"), self.lines.append)
        self.thread = threading.Thread(target=lambda: list(self.link.commands()))
        self.thread.start()

    def drives(self, velocity_mps: float, ranges: tuple[float, ...] | None) -> bool:
        """Send a command, and a ring unless there is none; True once the wheels turn in that direction."""
        self.link.send(pose())
        if ranges is not None:
            self.link.send(ControllerRing(time.monotonic_ns(), ranges))
        self.link.send(TimedSetpoint(time.monotonic_ns(), Setpoint(velocity_mps)))
        return self.base.line.base.velocity_mps * velocity_mps > 0.01

    def stands(self, velocity_mps: float, ranges: tuple[float, ...] | None) -> bool:
        """Send the same; True once the wheels stand."""
        self.drives(velocity_mps, ranges)
        return self.base.line.base.velocity_mps == 0.0


@pytest.fixture
def robot(tmp_path: Path) -> Iterator[RobotWithRings]:
    with contextlib.closing(Base(tmp_path)) as base:
        robot = RobotWithRings(base)
        try:
            yield robot
        finally:
            robot.link.end()
            robot.thread.join(20)
            robot.link.close()


@pytest.mark.hazard("H16")
def test_the_wheels_stop_before_an_obstacle_and_may_back_out(robot: RobotWithRings) -> None:
    wait_until(lambda: robot.drives(0.3, FREE), "motion")
    wait_until(lambda: robot.stands(0.3, WALL), "the stop")
    state = robot.link.statistics.state
    assert state.blocked and state.obstacle == BLOCKED and state.obstacle_stops == 1 and state.armed
    assert any(line == f"the wheels stop: {BLOCKED}; {REMEDY}" for line in robot.lines)
    wait_until(lambda: robot.drives(-0.3, WALL), "the way back")


@pytest.mark.hazard("H21")
def test_the_wheels_stop_when_no_more_rings_come(robot: RobotWithRings) -> None:
    wait_until(lambda: robot.drives(0.3, FREE), "motion")
    wait_until(lambda: robot.stands(0.3, None), "the stop")
    assert robot.link.statistics.state.obstacle == RING_STALE
    wait_until(lambda: robot.drives(0.3, FREE), "motion again, without arming")


@pytest.mark.hazard("H21")
def test_without_any_ring_the_wheels_never_turn(robot: RobotWithRings) -> None:
    begin_s = time.monotonic()
    wait_until(lambda: robot.drives(0.3, None) or time.monotonic() > begin_s + 1.5, "1.5 s")
    wait_until(lambda: robot.drives(0.3, None) or robot.link.statistics.state.obstacle == RING_STALE, "the reason")
    assert robot.base.line.base.velocity_mps == 0.0 and robot.link.statistics.state.sent > 0
