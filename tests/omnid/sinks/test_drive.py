"""Poses on their way to the controller process: setpoints of a replay, and a motor controller that fails."""

from __future__ import annotations

import time
from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest

from drivers.errors import DriverError
from drivers.motor import VelocityCommand
from omnid.controller.link import ControllerStatistics
from omnid.core.control.command_sources import TimedSetpoint
from omnid.core.control.control_law import ControllerPose
from omnid.core.control.heading_controller import Setpoint
from omnid.engine.telemetry import StageStats
from omnid.messages import NavigationUpdate, OdometryUpdate, RequestAnswer
from omnid.navigation_state import NavigationState
from omnid.sinks.drive import PlannerDrive, ReplayDrive
from omnid.tracking_state import TrackingState
from omnid.transport.topics import Answer

AHEAD = Setpoint(0.3, 0.0)


class Link:
    """A link without a process, which keeps what it sends."""

    def __init__(self) -> None:
        self.poses: list[ControllerPose] = []
        self.setpoints: list[tuple[Setpoint, int]] = []
        self.statistics = ControllerStatistics(StageStats("motor"))
        self.ended = False

    def send(self, given: ControllerPose | TimedSetpoint) -> None:
        if isinstance(given, ControllerPose):
            self.poses.append(given)
        else:
            self.setpoints.append((given.setpoint, given.arrival_ns))

    def receive_waiting(self) -> None:
        """Nothing waits."""

    def end(self) -> None:
        self.ended = True

    def commands(self) -> Iterator[VelocityCommand]:
        assert self.ended, "the process is asked to end before its end is awaited"
        return iter(())


def odometry(stamp_ns: int) -> OdometryUpdate:
    depth: Any = None
    return OdometryUpdate(
        0, stamp_ns, np.eye(4), np.eye(6), np.zeros(6), np.eye(6), TrackingState.TRACKING, 0, 99, 99, depth
    )


@pytest.fixture
def link() -> Any:
    return Link()


def test_a_pose_of_a_replay_counts_as_captured_on_arrival_and_renews_the_setpoint(link: Any) -> None:
    drive = ReplayDrive(link, AHEAD, np.eye(4))
    before_ns = time.monotonic_ns()
    for stamp_ns in (10**18, 10**18 + 10**8):
        drive.process(odometry(stamp_ns))
    assert [setpoint for setpoint, _ in link.setpoints] == [AHEAD, AHEAD]
    assert all(before_ns <= pose.stamp_ns <= time.monotonic_ns() for pose in link.poses)
    assert [arrival_ns for _, arrival_ns in link.setpoints] == [pose.stamp_ns for pose in link.poses]


def test_a_motor_controller_that_failed_ends_a_replay(link: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    drive = ReplayDrive(link, AHEAD, np.eye(4))
    link.statistics.state.failed = True
    drive.process(odometry(1))
    monkeypatch.setattr("omnid.sinks.drive.FAILED_S", -1.0)
    with pytest.raises(DriverError, match="does not answer"):
        drive.process(odometry(2))
    with pytest.raises(DriverError, match="does not answer"):
        drive.finish()


def test_the_answers_of_the_navigation_are_given(link: Any) -> None:
    answered: list[tuple[int, Answer]] = []
    drive = PlannerDrive(link, lambda id, answer: answered.append((id, answer)))
    answers = (RequestAnswer(4, "pause", ""), RequestAnswer(5, "repeat lost", "no route lost"))
    update = NavigationUpdate(1, 1, AHEAD, NavigationState.PAUSED, "by a request", answers=answers)
    drive.process(update)
    assert answered == [(4, Answer(True, "paused: by a request")), (5, Answer(False, "no route lost"))]
    assert [setpoint for setpoint, _ in link.setpoints] == [AHEAD]
