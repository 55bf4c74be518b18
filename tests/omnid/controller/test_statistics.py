"""Reports of the controller's ticks, and the statistics that the daemon keeps of them."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest

from omnid.controller.statistics import ControllerState
from omnid.core.control.collision_monitor import BLOCKED, CollisionSettings, ControllerRing
from tests.omnid.controller.bench import (
    SETTINGS,
    UNATTENDED,
    Bench,
)


@pytest.fixture
def bench() -> Bench:
    return Bench(UNATTENDED)


def test_counts_commands_and_stops_before_obstacles() -> None:
    bench = Bench(replace(SETTINGS, collision=CollisionSettings()))

    def drive(ranges: tuple[float, ...], ticks: int) -> ControllerState:
        for _ in range(ticks):
            bench.send_pose()
            bench.controller.take(ControllerRing(bench.now_ns, ranges))
            bench.send_setpoint()
            bench.tick()
        return bench.controller.state

    bench.send_pose()
    bench.arm()
    bench.tick()
    free = (math.inf,) * 360
    state = drive(free, 20)
    assert state.sent == len(bench.wheels.commands) == 21 and not state.blocked and not state.obstacle
    slowed = drive(tuple(0.9 if 150 <= k < 210 else math.inf for k in range(360)), 3)
    assert slowed.obstacle and not slowed.blocked and slowed.obstacle_stops == 0
    for number in (1, 2):
        stopped = drive(tuple(0.38 if 150 <= k < 210 else math.inf for k in range(360)), 10)
        assert stopped.blocked and stopped.obstacle == BLOCKED and stopped.obstacle_stops == number
        assert not drive(free, 10).blocked
