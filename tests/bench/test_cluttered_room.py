"""Cluttered rooms of the obstacle benchmark: there is room at the start, and the operator looks for another way."""

from __future__ import annotations

import math
import random
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from omnid.core.control.heading_controller import Setpoint, wrap_angle
from omnid.simulation.clearance import clearance_m, footprints
from omnid.simulation.robot import make_robot
from omnid.simulation.world_file import WorldOptions, parse_world
from tests.bench.cluttered_room import (
    ABOUT_RAD,
    AT_EDGE,
    BEYOND_M,
    CLEAR_M,
    DROPS_M,
    LEG_S,
    STANDS_S,
    WALK_M,
    WALKS_APART_M,
    WITH_PEOPLE,
    Wanderer,
    furnished,
    lowered,
    room_text,
)

PERIOD_S = 0.1


@pytest.mark.parametrize("seed", range(1, 4))
def test_rooms_are_full_and_leave_room_at_the_start(seed: int) -> None:
    text = room_text("polished clutter", random.Random(seed))
    world = furnished(parse_world(text, "clutter", seed, WorldOptions()), random.Random(seed))
    assert world.is_polished and text.count("[[box]]") >= 10
    robot = make_robot()
    assert clearance_m(footprints(world.standing, robot.height_m), world.start[:2], robot.radius_m) > CLEAR_M - 0.3


@pytest.mark.parametrize("seed", range(1, 4))
def test_people_walk_to_and_fro_apart_from_things(seed: int) -> None:
    world = parse_world(room_text(WITH_PEOPLE, random.Random(seed)), "clutter", seed, WorldOptions())
    assert world.people
    things = footprints([part for part in world.standing if part.name != "floor"], 1.0)
    for person in world.people:
        assert person.repeat == "back and forth" and math.dist(*person.path) > WALK_M
        ways = np.linspace(*person.path, 50)
        assert min(clearance_m(things, (x, y), 0.0) for x, y in ways.tolist()) > WALKS_APART_M - 0.45


@pytest.mark.parametrize("seed", range(1, 4))
def test_the_floor_falls_beyond_the_things_and_the_operator_often_drives_there(seed: int) -> None:
    world = parse_world(room_text(AT_EDGE, random.Random(seed)), "clutter", seed, WorldOptions())
    far_m = max(float(part.origin[0]) for part in world.standing)
    fallen, edge = lowered(world, random.Random(seed))
    assert edge[0, :, 0] == pytest.approx(far_m - BEYOND_M, abs=0.02)
    assert -min(float(part.origin[2]) for part in fallen.standing) in DROPS_M
    headings = {setpoint.heading_rad for setpoint in setpoints(0.0, 60.0, towards_rad=2.0)}
    near = [heading for heading in headings if heading and abs(wrap_angle(heading - 2.0)) < ABOUT_RAD]
    assert 0.4 < len(near) / len(headings) < 0.9


def moment(time_s: float, x_m: float) -> Any:
    """Return the part of a moment at which an operator looks."""
    T = np.eye(4)
    T[0, 3] = x_m
    return SimpleNamespace(
        time_s=time_s, odometry=object(), controller=SimpleNamespace(armed=time_s > 0.5), T_odom_base=T
    )


def setpoints(speed_mps: float, seconds: float, towards_rad: float | None = None) -> list[Setpoint]:
    wanderer, found = Wanderer(1, towards_rad), []
    for n in range(round(seconds / PERIOD_S)):
        requests = list(wanderer(moment(n * PERIOD_S, speed_mps * n * PERIOD_S)))
        assert ("arm" in requests) == (n * PERIOD_S <= 0.5)
        found += [request for request in requests if isinstance(request, Setpoint)]
    return found


def test_the_operator_holds_the_stick_for_some_seconds_and_turns_away_where_the_base_stands() -> None:
    driving, standing = (len({s.heading_rad for s in setpoints(speed_mps, 30.0)}) for speed_mps in (0.5, 0.0))
    assert 30.0 / LEG_S[1] <= driving <= 30.0 / LEG_S[0] + 1
    assert math.floor(30.0 / (STANDS_S + 2 * PERIOD_S)) <= standing <= 30.0 / STANDS_S + 1
