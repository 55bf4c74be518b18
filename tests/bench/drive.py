"""Closed-loop drives in lock-step against the truth at the wheels: `python -m tests.bench.drive CASE --seeds 1 2`.

Every case is a script: it arms the robot and sends goals as a person would. A row for each seed:
what the navigation said at the end, true distance and heading error to the last goal, largest distance of the true
path to the straight legs, contacts, least clearance; of a time in the dark the way and the error that it added to
the pose; when slip was noticed, after it began, and how many pairs noticed it at other times.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from calib import se3
from omnid.core.control.heading_controller import wrap_angle
from omnid.core.navigation.requests import GoalRequest, NavigationFrame
from omnid.navigation_state import NavigationState
from omnid.simulation.demonstration import cross_track_m
from omnid.simulation.lockstep import Moment, Request, SimulatedRun
from omnid.simulation.robot import make_robot
from omnid.simulation.vehicle import START_NS
from omnid.simulation.world import World
from omnid.simulation.world_file import load_world
from tests.bench.results import Cell, ResultTable, columns, run
from tests.simulation.disturbed import Fault, Slip, disturbed, simulate

Goal = tuple[float, float, float]  # x [m], y [m], heading [deg] in odom
NOTICED_LATE_S = 0.5  # after its end, within which slip may be noticed


@dataclass
class Goals:
    """Arms the robot, and sends each goal when the one before is reached."""

    goals: list[Goal]
    sent: int = 0
    sent_s: float = 0.0

    def __call__(self, moment: Moment) -> Iterator[Request]:
        if moment.odometry is None:
            return
        if not moment.controller.armed and moment.time_s < 2.0:
            yield "arm"
            return
        state = None if moment.navigation is None else moment.navigation.state
        ended = state is not None and state.is_end and moment.time_s > self.sent_s + 1.0
        if self.sent == len(self.goals) and ended:
            yield "end"
        ready = self.sent == 0 or (state is NavigationState.REACHED and ended)
        if moment.controller.armed and ready and self.sent < len(self.goals):
            x_m, y_m, heading_deg = self.goals[self.sent]
            self.sent += 1
            self.sent_s = moment.time_s
            yield GoalRequest(NavigationFrame.ODOM, x_m, y_m, math.radians(heading_deg))


@dataclass
class Case:
    """A drive: world of a seed, goals, duration, faults, slips."""

    world: Callable[[int], World]
    goals: list[Goal]
    seconds: float
    faults: tuple[Fault, ...] = ()
    slips: tuple[Slip, ...] = ()
    sensors: bool = True  # odometry of the wheels, and a gyro


COLUMNS = columns(
    *("case", "seed", "end", "end error|cm|1", "heading|deg|2", "off the legs|cm|1", "way|m|2", "contacts"),
    *("clearance|m|2", "in the dark", "slip noticed", "stops", "processor time a pair|s|2"),
)
STRAIGHT: list[Goal] = [(10.0, 0.0, 0.0)]
SQUARE: list[Goal] = [(2.5, 0.0, 90.0), (2.5, 2.5, 180.0), (0.0, 2.5, -90.0), (0.0, 0.0, 0.0)]
DARK = Fault("dark", 10.0, 13.0)
SLIP = Slip(10.0, 11.0, 0.2)


def corridor(seed: int) -> World:
    """Return the corridor without its person."""
    world = load_world("corridor", seed)
    return World(world.name, world.standing, (), world.start)


CASES: dict[str, Case] = {
    "straight": Case(corridor, STRAIGHT, 90.0),
    "square": Case(lambda seed: load_world("room", seed), SQUARE, 120.0),
    "dark": Case(corridor, STRAIGHT, 90.0, (DARK,)),
    "dark without": Case(corridor, STRAIGHT, 20.0, (DARK,), sensors=False),
    "slip": Case(corridor, STRAIGHT, 90.0, (), (SLIP,)),
}


def row(case: Case, driven: SimulatedRun) -> list[Cell]:
    """Return the figures of a drive."""
    x_m, y_m, heading_rad = driven.ticks[-1].pose
    end = se3.inverse(driven.T_world_base[0]) @ se3.transform(se3.rotation_exp([0, 0, heading_rad]), [x_m, y_m, 0.0])
    goal, legs = case.goals[-1], np.array([(0.0, 0.0), *((x, y) for x, y, _ in case.goals)])
    error_deg = math.degrees(wrap_angle(float(se3.yaw(end)) - math.radians(goal[2])))
    state = f"{driven.navigation[-1].state} {driven.navigation[-1].reason}".strip() if driven.navigation else ""
    moved = np.diff([tick.pose[:2] for tick in driven.ticks], axis=0)
    stops = [line for _, line in driven.lines if line.startswith("the wheels stop")]
    return [
        state,
        100 * math.dist(end[:2, 3], goal[:2]),
        abs(error_deg),
        100 * cross_track_m(legs, driven.truth_in_odom[:, :2, 3]).max(),
        float(np.linalg.norm(moved, axis=1).sum()),
        len(driven.contacts),
        driven.clearance_m,
        dark(case, driven),
        slip(case, driven),
        "; ".join(dict.fromkeys(stops))[:120],
    ]


def dark(case: Case, driven: SimulatedRun) -> str:
    """Return way [m] and error [cm] of the poses of the time in the dark, from the last pair before it on."""
    times_s = (driven.stamps_ns - START_NS) * 1e-9
    texts = []
    for fault in case.faults:
        first, last = np.searchsorted(times_s, (fault.start_s, fault.end_s)) - 1
        truth, estimate = (
            se3.inverse(poses[first]) @ poses[last] for poses in (driven.T_world_base, driven.T_odom_base)
        )
        way_m = np.linalg.norm(np.diff(driven.T_world_base[first : last + 1, :2, 3], axis=0), axis=1).sum()
        error_m = np.linalg.norm((se3.inverse(truth) @ estimate)[:2, 3])
        texts.append(f"{way_m:.2f} m, {100 * error_m:.1f} cm")
    return "; ".join(texts)


def slip(case: Case, driven: SimulatedRun) -> str:
    """Return when slip was noticed after it began [s], and how many pairs noticed it at other times."""
    times_s = (driven.stamps_ns - START_NS) * 1e-9
    at_slips, texts = np.zeros(len(times_s), bool), []
    for slipped in case.slips:
        within = (times_s >= slipped.start_s) & (times_s < slipped.end_s + NOTICED_LATE_S)
        noticed_s = times_s[within & driven.slipping]
        texts.append(f"{noticed_s[0] - slipped.start_s:.1f} s" if len(noticed_s) else "not noticed")
        at_slips |= within
    return "; ".join([*texts, str(int((driven.slipping & ~at_slips).sum()))])


def drive(
    cases: Sequence[Literal["straight", "square", "dark", "dark without", "slip", "all"]],
    *,
    seeds: Sequence[int] = (1,),
    size: int = 512,
) -> None:
    """Print a row for each case and seed."""
    table = ResultTable("drive", "A simulated robot in a closed loop", COLUMNS)
    for name in CASES if "all" in cases else cases:
        case = CASES[name]
        for seed in seeds:
            robot = disturbed(make_robot(size), slips=case.slips, has_odometry=case.sensors, has_gyro=case.sensors)
            started_s, script = time.process_time(), Goals(case.goals)
            driven = simulate(case.world(seed), robot, script, seconds=case.seconds, seed=seed, faults=case.faults)
            spent_s = (time.process_time() - started_s) / max(1, len(driven.stamps_ns))
            table.add(name, seed, *row(case, driven), spent_s, seed=(f"drive {name}", seed))


if __name__ == "__main__":
    run(drive)
