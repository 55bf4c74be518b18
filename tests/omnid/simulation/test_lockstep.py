"""A robot that drives in lock-step: reproducible to the byte, and its commands change its images.

The base stops before what parts of images that are dead or blind no longer show, and its map calls nothing free where a
low box or a pole stands.
"""

from __future__ import annotations

import math
import sys
from collections.abc import Iterator
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest

from calib import se3
from omnid.cli import main
from omnid.client import Diagnostics, Robot
from omnid.config import load_config
from omnid.core.control.collision_monitor import IMAGES_REMEDY, UNOBSERVED, UNSEEN
from omnid.core.control.heading_controller import Setpoint
from omnid.core.mapping.scan_grid import FREE, UNKNOWN
from omnid.core.places.place_views import grid
from omnid.formats.place_file import read_places
from omnid.formats.tum import read_tum
from omnid.simulation.robot import make_robot
from omnid.simulation.world import World, load_world
from omnid.transport.session import BusConfig
from omnid.transport.status_names import SIMULATION, STAGE_PREFIX, WHEELS, Key
from tests.bench.faults.images import Frozen, sector
from tests.bench.obstacles import ahead
from tests.busy import stopped_by_turns
from tests.ports import free_port
from tests.replay.live import started
from tests.simulation import lockstep
from tests.simulation.disturbed import Fault, Tamper, least_clearance_m, simulate
from tests.simulation.lockstep import Moment, Request, SimulatedRun
from tests.waiting import wait_until

SIZE = 160
CONFIG = load_config(None, ["controller.collision.unknown=slow"])  # such small images show little of the floor
SIZE_PX = 256
STARTS_S = 1.5
WITHOUT_PLACES = load_config(None, ["places.enabled=false"])
AHEAD, BEHIND = sector(SIZE_PX, 0.0, 180.0), sector(SIZE_PX, 180.0, 120.0)


@cache
def world() -> World:
    """Return the shipped room: its textures take a fifth of a second."""
    return load_world("room", 3)


def forward(moment: Moment) -> Iterator[Request]:
    """Arm, and drive ahead from the first pose on."""
    if moment.odometry is not None and not moment.controller.armed:
        yield "arm"
    yield Setpoint(0.3, yaw_rate_radps=0.1)


def drive(seed: int, seconds: float = 2.0, **options: object) -> SimulatedRun:
    return simulate(world(), make_robot(SIZE), forward, seconds=seconds, seed=seed, config=CONFIG, **options)  # type: ignore[arg-type]


@pytest.fixture(scope="module")
def run() -> SimulatedRun:
    return drive(1)


def test_the_same_seed_gives_the_same_bytes(run: SimulatedRun) -> None:
    again, other = drive(1), drive(2, 1.2)
    assert run.ticks == again.ticks and run.T_odom_base.tobytes() == again.T_odom_base.tobytes()
    # The other seed's first second, before the run ends.
    assert run.ticks[:20] != other.ticks[:20] and not np.array_equal(run.T_odom_base[:10], other.T_odom_base[:10])


def test_the_robot_follows_its_setpoint_and_estimates_its_own_motion(run: SimulatedRun) -> None:
    truth, estimate = run.truth_in_odom[-1], run.T_odom_base[-1]
    assert 0.2 < truth[0, 3] < 0.6 and 0.02 < float(se3.yaw(truth)) < 0.2
    np.testing.assert_allclose(estimate[:2, 3], truth[:2, 3], atol=0.03)
    assert float(se3.yaw(estimate)) == pytest.approx(float(se3.yaw(truth)), abs=math.radians(1.5))
    assert run.contacts == [] and least_clearance_m(run) > 0.3


def test_a_motor_that_is_cut_off_stops_by_its_own_watchdog() -> None:
    run = drive(1, 3.0, faults=(Fault("motor cut", 1.5, 9.0),))
    places = {round(tick.time_s, 2): tick.pose[0] for tick in run.ticks}
    assert places[1.5] - places[1.4] > 0.015
    assert places[2.9] == places[2.5]
    assert any("no answer" in line for _, line in run.lines)


def fine_drive(tamper: Tamper | None = None, *faults: Fault) -> SimulatedRun:
    """Return a drive ahead at 0.5 m/s."""
    robot, changes = replace(make_robot(SIZE_PX), samples=1), {"faults": faults, "tamper": tamper}
    return simulate(world(), robot, ahead, seconds=3.0, seed=1, config=WITHOUT_PLACES, **changes)  # type: ignore[arg-type]


def stop_s(run: SimulatedRun, reason: str) -> float:
    """Return the time from the fault to the stop for a reason."""
    text = f"the wheels stop: {reason}; {IMAGES_REMEDY}"
    return next(at_s for at_s, line in run.lines if line == text) - STARTS_S


@pytest.mark.hazard("H22")
def test_a_base_stops_within_a_second_where_half_of_the_images_freezes_ahead() -> None:
    """It would go on by memory, and by landmarks of the other half."""
    run = fine_drive(Frozen(AHEAD, starts_s=STARTS_S))
    assert 0.0 < stop_s(run, UNOBSERVED) < 1.0
    speeds = np.linalg.norm(np.diff([tick.pose[:2] for tick in run.ticks], axis=0), axis=1)
    assert speeds[-20:].max() < 1e-4
    # Landmarks in the dead half would show a base at rest.
    np.testing.assert_allclose(run.T_odom_base[-1, :2, 3], run.truth_in_odom[-1, :2, 3], atol=0.03)
    assert {pose.state for pose in run.poses[5:]} <= {"tracking", "degraded"}


@pytest.mark.hazard("H22")
def test_a_base_that_drives_away_from_a_dead_part_drives_on() -> None:
    """A third of the images freezes, behind the base."""
    run = fine_drive(Frozen(BEHIND, starts_s=STARTS_S))
    assert not [line for _, line in run.lines if UNOBSERVED in line]
    np.testing.assert_allclose(run.T_odom_base[-1, :2, 3], run.truth_in_odom[-1, :2, 3], atol=0.03)


@pytest.mark.hazard("H23")
@pytest.mark.parametrize("gyro", [True, False])
def test_in_the_dark_a_base_stops_although_wheels_carry_its_pose(gyro: bool) -> None:
    """Within half a second, and the time of the ramp."""
    robot, dark = replace(make_robot(SIZE_PX), samples=1), Fault("dark", STARTS_S, 9.0)
    config = load_config(None, ["places.enabled=false", f"motion.imu={'auto' if gyro else 'off'}"])
    run = simulate(world(), robot, ahead, seconds=3.0, seed=1, config=config, faults=(dark,))
    assert 0.0 < stop_s(run, UNSEEN) < 0.5
    assert "lost" not in {pose.state for pose in run.poses}


BOX_M = (1.6, 0.75), (0.4, 0.4, 0.08)  # its middle, and its sides
POLE_M = (1.3, -0.8), (0.06, 0.06, 1.8)
SECONDS = 7.0
WORLD = f"""
schema = 1
start = [0.0, 0.0, 0.0]
[space]
low = [-2.0, -1.3]
high = [6.0, 1.3]
[[wall]]
points = [[-2.0, -1.3], [-2.0, 1.3], [6.0, 1.3], [6.0, -1.3], [-2.0, -1.3]]
texture = "granite"
[[box]]
at = {list(BOX_M[0])}
size_m = {list(BOX_M[1])}
[[box]]
at = {list(POLE_M[0])}
size_m = {list(POLE_M[1])}
texture = "white"
"""


def test_the_floor_that_was_driven_is_free_and_a_low_box_and_a_white_pole_beside_it_are_not(tmp_path: Path) -> None:
    (tmp_path / "world.toml").write_text(WORLD)
    hall, map_file = load_world(str(tmp_path / "world.toml"), 1), tmp_path / "m.omap"
    run = lockstep.simulate(
        hall,
        replace(make_robot(384), samples=4),
        ahead,
        seconds=SECONDS,
        config=load_config(None, [f'places.map="{map_file}"']),
    )
    assert run.ticks[-1].pose[0] > 1.8 and not run.contacts
    places, rig = read_places(map_file)
    found = grid(places, rig, 0.05)
    rows, columns = np.indices(found.cells.shape)
    x = found.corner[0] + (columns + 0.5) * found.cell_m
    y = found.corner[1] + (rows + 0.5) * found.cell_m
    in_box, in_pole = (
        (np.abs(x - x_m) < length / 2) & (np.abs(y - y_m) < width / 2)
        for (x_m, y_m), (length, width, _) in (BOX_M, POLE_M)
    )
    driven = (x > 0.2) & (x < 1.8) & (np.abs(y) < 0.15)
    assert (found.cells[driven] == FREE).mean() > 0.9
    assert in_box.sum() > 50 and (found.cells[in_box] == UNKNOWN).all()
    assert in_pole.any() and (found.cells[in_pole] == UNKNOWN).all()


# `omnid simulate` in its own time: a daemon that is slowed down loses nothing, and reaches its goal.
STOPPED_S, RUNNING_S = 0.6, 0.3  # longer than the deadlines of poses and commands; share of a computer that is left
NEAR_M = 0.05
GOAL = ("0.3", "0.05")


def newest(port: int) -> Diagnostics:
    """Return a whole status of the daemon."""
    with (
        Robot(settings=BusConfig(connect=(f"tcp/127.0.0.1:{port}",))) as robot,
        robot.subscribe(Diagnostics) as statuses,
    ):
        while True:
            report = statuses.wait(20.0)
            assert report is not None
            if len(report.statuses) > 1:
                return report


def test_a_slowed_daemon_reaches_its_goal_and_loses_nothing(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    port, truth = free_port(), tmp_path / "truth.tum"
    connect = ["--connect", f"tcp/127.0.0.1:{port}"]
    command = [
        *(sys.executable, "-m", "omnid", "simulate", "room", "--no-people", "--size", "320"),
        *("--truth", str(truth)),
        *("--set", f'bus.listen=["tcp/127.0.0.1:{port}"]'),
        *("--set", "live.status_s=0.2"),
        *("--set", "controller.collision.unknown=slow"),
    ]  # such small images show little of the floor
    with started(command, port) as daemon:
        wait_until(lambda: main(["arm", *connect]) == 0, "arming")
        with Robot(connect=connect[1]) as robot:
            assert robot.driver().goal(0.2, 0.0).done
        assert [main(["goto", word, *connect]) for word in ("--pause", "--resume")] == [0, 0]
        assert "paused: by a request: `omnid goto --resume`" in capsys.readouterr().out
        with stopped_by_turns(daemon.process, RUNNING_S, STOPPED_S):
            reached = main(["goto", *GOAL, *connect])
        status = newest(port)
        with Robot(settings=BusConfig(connect=(f"tcp/127.0.0.1:{port}",))) as robot:
            clocks: list[bytes] = []
            robot.on_message(lambda _, payload, __: clocks.append(payload), "clock")
            wait_until(lambda: len(set(clocks)) > 2, "the simulated time on the bus")
        code, log = daemon.end()
    assert reached == 0, log
    # 1. Nothing was lost on the way, and no rule stopped the wheels.
    stages = {entry.name: entry.values for entry in status.statuses if entry.name.startswith(STAGE_PREFIX)}
    dropped = {name: values[Key.DROPPED] for name, values in stages.items() if Key.DROPPED in values}
    assert {f"{STAGE_PREFIX}bus-poses", f"{STAGE_PREFIX}odometry"} <= set(dropped)
    lossy = {f"{STAGE_PREFIX}bus-status"}  # it comes by the time on the wall, and the newest counts
    assert {name for name, count in dropped.items() if count != "0"} <= lossy
    assert status.value(WHEELS, Key.ARMED) == "1"
    # 2. Its time went more slowly than that on the wall.
    assert 0 < float(status.value(SIMULATION, Key.REAL_TIME_FACTOR)) <= 1.0
    # 3. The robot rests at the goal, and its drive was not cut short.
    assert "the command is stale" not in log
    assert code == 0 and "contacts with obstacles: 0" in log
    assert math.dist(read_tum(truth).T[-1, :2, 3], tuple(map(float, GOAL))) < NEAR_M
