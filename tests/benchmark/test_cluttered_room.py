"""Cluttered rooms of the obstacle benchmark: there is room at the start, and the operator looks for another way."""

from __future__ import annotations

import math
import random
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from omnid.core.control.heading_controller import Setpoint
from omnid.simulation.clearance import clearance_m, footprints
from omnid.simulation.robot import make_robot
from omnid.simulation.world_file import WorldOptions, parse_world
from tests.benchmark.cluttered_room import CLEAR_M, LEG_S, STANDS_S, Wanderer, furnished, room_text

PERIOD_S = 0.1


@pytest.mark.parametrize("seed", range(1, 4))
def test_rooms_are_full_and_leave_room_at_the_start(seed: int) -> None:
    text = room_text("polished clutter", random.Random(seed))
    world = furnished(parse_world(text, "clutter", seed, WorldOptions()), random.Random(seed))
    assert world.is_polished and text.count("[[box]]") >= 10
    robot = make_robot()
    assert clearance_m(footprints(world.standing, robot.height_m), world.start[:2], robot.radius_m) > CLEAR_M - 0.3


def moment(time_s: float, x_m: float) -> Any:
    """Return the part of a moment at which an operator looks."""
    T = np.eye(4)
    T[0, 3] = x_m
    return SimpleNamespace(
        time_s=time_s, odometry=object(), controller=SimpleNamespace(armed=time_s > 0.5), T_odom_base=T
    )


def setpoints(speed_mps: float, seconds: float) -> list[Setpoint]:
    wanderer, found = Wanderer(1), []
    for n in range(round(seconds / PERIOD_S)):
        requests = list(wanderer(moment(n * PERIOD_S, speed_mps * n * PERIOD_S)))
        assert ("arm" in requests) == (n * PERIOD_S <= 0.5)
        found += [request for request in requests if isinstance(request, Setpoint)]
    return found


def test_the_operator_holds_the_stick_for_some_seconds_and_turns_away_where_the_base_stands() -> None:
    driving, standing = (len({s.heading_rad for s in setpoints(speed_mps, 30.0)}) for speed_mps in (0.5, 0.0))
    assert 30.0 / LEG_S[1] <= driving <= 30.0 / LEG_S[0] + 1
    assert math.floor(30.0 / (STANDS_S + 2 * PERIOD_S)) <= standing <= 30.0 / STANDS_S + 1
