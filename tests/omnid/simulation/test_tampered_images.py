"""Parts of images that are dead or blind, in a closed loop: the base stops before what they no longer show."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from omnid.config import load_config
from omnid.core.control.collision_monitor import IMAGES_REMEDY, UNSEEN, UNWATCHED
from omnid.simulation.lockstep import SimulatedRun
from omnid.simulation.robot import make_robot
from omnid.simulation.world import World
from omnid.simulation.world_file import load_world
from tests.bench.faults.images import Frozen, sector
from tests.bench.obstacles import ahead
from tests.simulation.disturbed import Fault, Tamper, simulate

SIZE_PX = 256
STARTS_S = 1.5
CONFIG = load_config(None, ["places.enabled=false"])
AHEAD, BEHIND = sector(SIZE_PX, 0.0, 180.0), sector(SIZE_PX, 180.0, 120.0)


@cache
def world() -> World:
    """Return the shipped room: its textures take a fifth of a second."""
    return load_world("room", 3)


def drive(tamper: Tamper | None = None, *faults: Fault) -> SimulatedRun:
    """Return a drive ahead at 0.5 m/s."""
    return simulate(
        world(),
        replace(make_robot(SIZE_PX), samples=1),
        ahead,
        seconds=3.0,
        seed=1,
        config=CONFIG,
        faults=faults,
        tamper=tamper,
    )


def stop_s(run: SimulatedRun, reason: str) -> float:
    """Return the time from the fault to the stop for a reason."""
    text = f"the wheels stop: {reason}; {IMAGES_REMEDY}"
    return next(at_s for at_s, line in run.lines if line == text) - STARTS_S


@pytest.mark.hazard("H22")
def test_a_base_stops_within_a_second_where_half_of_the_images_freezes_ahead() -> None:
    """It would go on by memory, and by landmarks of the other half."""
    run = drive(Frozen(AHEAD, starts_s=STARTS_S))
    assert 0.0 < stop_s(run, UNWATCHED) < 1.0
    speeds = np.linalg.norm(np.diff([tick.pose[:2] for tick in run.ticks], axis=0), axis=1)
    assert speeds[-20:].max() < 1e-4
    # Landmarks in the dead half would say that the base stands.
    np.testing.assert_allclose(run.T_odom_base[-1, :2, 3], run.truth_in_odom[-1, :2, 3], atol=0.03)
    assert set(run.states[5:]) <= {"tracking", "degraded"}


@pytest.mark.hazard("H22")
def test_a_base_that_drives_away_from_a_dead_part_drives_on() -> None:
    """A third of the images, behind it."""
    run = drive(Frozen(BEHIND, starts_s=STARTS_S))
    assert not [line for _, line in run.lines if UNWATCHED in line]
    np.testing.assert_allclose(run.T_odom_base[-1, :2, 3], run.truth_in_odom[-1, :2, 3], atol=0.03)


@pytest.mark.hazard("H23")
@pytest.mark.parametrize("gyro", [True, False])
def test_in_the_dark_a_base_stops_although_wheels_carry_its_pose(gyro: bool) -> None:
    """Half a second, and the ramp."""
    run = simulate(
        world(),
        replace(make_robot(SIZE_PX), samples=1, has_gyro=gyro),
        ahead,
        seconds=3.0,
        seed=1,
        config=CONFIG,
        faults=(Fault("dark", STARTS_S, 9.0),),
    )
    assert 0.0 < stop_s(run, UNSEEN) < 0.5
    assert "lost" not in run.states
