"""Closed-loop drives in lock-step against the truth at the wheels: `python -m tests.bench.drive goals|routes`.

goals: every case is a script that arms the robot and sends goals as a person would. A row for each seed:
what the navigation said at the end, true distance and heading error to the last goal, largest distance of the true
path to the straight legs, contacts, least clearance; of a time in the dark the way and the error that it added to
the pose; when slip was noticed, after it began, and how many pairs noticed it at other times.

routes: in the corridor around the rooms of `building` a route is taught: a round of 33 m, or its first metres. It is
repeated in the saved map from other starts on it, with other light, a fifth of the posters exchanged, and two people
who walk across the corridor when the robot comes near.
"""

from __future__ import annotations

import math
import random
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Final, Literal

import numpy as np

from calib import se3
from calib.models.camera import Array
from omnid.config import load_config
from omnid.core.control.heading_controller import Setpoint, wrap_angle
from omnid.core.navigation.requests import (
    GoalRequest,
    NavigationFrame,
    NavigationState,
    PathRequest,
    RouteAction,
    RouteRequest,
)
from omnid.simulation.rendering.surfaces import poster
from omnid.simulation.robot import START_NS, make_robot
from omnid.simulation.world import Walker, World, distances_m, load_world
from omnid.tracking_state import MapState
from tests.bench.results import Cell, ResultTable, columns, run
from tests.simulation.disturbed import Fault, Slip, disturbed, least_clearance_m, simulate
from tests.simulation.lockstep import Moment, Request, SimulatedRun

Goal = tuple[float, float, float]  # x [m], y [m], heading [deg] in odom
ANSWER_S = 0.5  # after a request, within which no end of its drive is looked for
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
        100 * distances_m(np.stack([legs[:-1], legs[1:]], axis=1), driven.truth_in_odom[:, :2, 3]).max(),
        float(np.linalg.norm(moved, axis=1).sum()),
        len(driven.contacts),
        least_clearance_m(driven),
        dark(case, driven),
        slip(case, driven),
        "; ".join(dict.fromkeys(stops))[:120],
    ]


def dark(case: Case, driven: SimulatedRun) -> str:
    """Return way [m] and error [cm] of the poses of the time in the dark, from the last pair before it on."""
    times_s = np.array([pose.stamp_ns - START_NS for pose in driven.poses]) * 1e-9
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
    times_s = np.array([pose.stamp_ns - START_NS for pose in driven.poses]) * 1e-9
    slipping = np.array([pose.is_slipping for pose in driven.poses], bool)
    at_slips, texts = np.zeros(len(times_s), bool), []
    for slipped in case.slips:
        within = (times_s >= slipped.start_s) & (times_s < slipped.end_s + NOTICED_LATE_S)
        noticed_s = times_s[within & slipping]
        texts.append(f"{noticed_s[0] - slipped.start_s:.1f} s" if len(noticed_s) else "not noticed")
        at_slips |= within
    return "; ".join([*texts, str(int((slipping & ~at_slips).sum()))])


def goals(
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
            robot, faults = disturbed(make_robot(size), slips=case.slips), case.faults
            config = load_config(None, () if case.sensors else ("motion.wheels=off", "motion.imu=off"))
            started_s, script = time.process_time(), Goals(case.goals)
            driven = simulate(
                case.world(seed), robot, script, seconds=case.seconds, seed=seed, config=config, faults=faults
            )
            spent_s = (time.process_time() - started_s) / max(1, len(driven.poses))
            table.add(name, seed, *row(case, driven), spent_s, seed=(f"drive {name}", seed))


# A route taught once and repeated.

ROUND: Final = np.array([(6.0, 1.05), (11.05, 1.05), (11.05, 7.95), (0.95, 7.95), (0.95, 1.05), (6.0, 1.05)])
CORNER_M: Final = 0.6  # radius of the corners
SPACING_M: Final = 0.05
STARTS: Final = (0.0, 0.3, 0.12, 0.6, 0.45)  # share of the way at which the repetitions begin
ASIDE_M, ASIDE_RAD = 0.1, math.radians(10)  # largest offset of a start from the route
SEEK_MPS, SEEK_S = 0.2, 20.0  # of driving by hand until the robot knows where it is
LONGEST_S: Final = 240.0
SETTLED_M: Final = 1.0  # way after which a repetition has come from its start to the route
DOORS: Final = (((8.42, 4.3), (8.42, 0.6)), ((4.95, 2.4), (4.95, 8.4)))  # ways of the people, from rooms


def lap(length_m: float) -> Array:
    """Return the first metres of the round (N, 2) [m] in the world, its corners rounded off."""
    points = [ROUND[:1]]
    arc = np.linspace(0.0, math.pi / 2, 15)[:, None]
    for before, corner, after in zip(ROUND, ROUND[1:], ROUND[2:], strict=False):
        u, v = (np.sign(other - corner) for other in (before, after))  # the sides are along the axes
        points.append(corner + CORNER_M * (u * (1 - np.sin(arc)) + v * (1 - np.cos(arc))))
    corners = np.concatenate([*points, ROUND[-1:]])
    way_m = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(corners, axis=0), axis=1))])
    at_m = np.arange(0.0, min(length_m, way_m[-1]), SPACING_M)
    return np.column_stack([np.interp(at_m, way_m, corners[:, axis]) for axis in (0, 1)])


@dataclass
class Route:
    """A script: arms the robot, then drives along a line while the route is taught, or repeats it where it is known."""

    taught: Array | None  # (N, 2) m in odom; None: the route is repeated
    end: str = "time is over"
    _asked_s: float = math.inf
    _waiting: list[Request] = field(default_factory=list)

    def __call__(self, moment: Moment) -> Iterator[Request]:
        """Yield the requests at a moment."""
        if moment.place is None:
            return
        if math.isinf(self._asked_s) and not moment.controller.armed:
            yield "arm"
        elif math.isinf(self._asked_s):
            yield from self._begin(moment, moment.place.state)
        elif moment.navigation is not None and moment.time_s > self._asked_s + ANSWER_S:
            answer, state = moment.navigation.answer, moment.navigation.state
            refusal = "" if answer is None else answer.refusal
            if self._waiting and not refusal and state is NavigationState.REACHED:
                yield self._waiting.pop(0)
                self._asked_s = moment.time_s
            elif refusal or state.is_end:
                self.end = refusal or f"{state} {moment.navigation.reason}".strip()
                yield "end"

    def _begin(self, moment: Moment, state: MapState) -> Iterator[Request]:
        if self.taught is not None:
            yield RouteRequest(RouteAction.TEACH, "round")
            yield PathRequest(NavigationFrame.ODOM, self.taught)
            self._waiting = [RouteRequest(RouteAction.FINISH)]
            self._asked_s = moment.time_s
        elif state is MapState.LOCALIZED:
            yield Setpoint(0.0)
            yield RouteRequest(RouteAction.REPEAT, "round")
            self._asked_s = moment.time_s
        elif moment.time_s > SEEK_S:
            self.end = "not recognised"
            yield "end"
        else:
            yield Setpoint(SEEK_MPS)


def later(seed: int, number: int, rng: random.Random) -> World:
    """Return the building at another time of the day, with people."""
    building, brightness = load_world("building", seed), rng.uniform(0.6, 1.3)
    posters = np.random.default_rng([number + 1, 42])
    standing = tuple(  # a fifth of the posters is exchanged
        replace(face, texture=poster(posters, (face.texture.shape[1], face.texture.shape[0])))
        if face.name.startswith("poster") and posters.random() < 0.2
        else face
        for face in building.standing
    )
    person = load_world("corridor").people[0]
    walking = tuple(
        replace(person, walk=Walker(path, rng.uniform(0.6, 1.0), start_s=rng.uniform(0.0, 10.0), starts_within_m=3.0))
        for path in DOORS
    )
    return replace(building, standing=standing, people=walking, brightness=brightness * building.brightness)


def route_row(taught: Array, driven: SimulatedRun) -> list[Cell]:
    """Return the figures of a drive against the true positions (N, 2) of the lesson."""
    path = np.array([tick.pose[:2] for tick in driven.ticks])
    way_m = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(path, axis=0), axis=1))])
    off_cm = 100 * distances_m(np.stack([taught[:-1], taught[1:]], axis=1), path)[way_m > SETTLED_M]
    p95, most = (np.percentile(off_cm, 95), off_cm.max()) if len(off_cm) else (None, None)
    end_cm = 100 * math.dist(path[-1], taught[-1])
    stops = dict.fromkeys(line for _, line in driven.lines if line.startswith("the wheels stop"))
    return [p95, most, end_cm, way_m[-1], len(driven.contacts), least_clearance_m(driven), "; ".join(stops)[:300]]


def routes(*, seeds: Sequence[int] = (1,), length: float = 33.0, size: int = 512) -> None:
    """Print a row for the lesson of a route of so many metres, and for each repetition."""
    head = columns(
        *("seed", "drive", "end", "off the lesson p95|cm|1", "most|cm|1", "end error|cm|1", "way|m|1", "contacts"),
        *("clearance|m|2", "stops"),
    )
    table, robot = ResultTable("routes", f"Repeated route of {length:g} m", head), make_robot(size)
    line = lap(length)
    for seed in seeds:
        with tempfile.TemporaryDirectory() as folder:
            files = [f"places.map={Path(folder) / 'building.omap'}", f"navigation.routes={Path(folder) / 'routes'}"]
            config, world = load_config(None, files), load_world("building", seed)
            script = Route(line - line[0])
            world = replace(world, start=(*line[0].tolist(), 0.0))
            driven = simulate(world, robot, script, seconds=LONGEST_S, seed=seed, config=config)
            taught = np.array([tick.pose[:2] for tick in driven.ticks])
            table.add(seed, "lesson", script.end, *route_row(taught, driven), seed=("route", seed))
            for number, share in enumerate(STARTS):
                rng, begin, script = random.Random(1000 * seed + number), round(share * len(line)), Route(None)
                x_m, y_m = line[begin] + (rng.uniform(-ASIDE_M, ASIDE_M), rng.uniform(-ASIDE_M, ASIDE_M))
                heading_rad = math.atan2(*(line[begin + 2] - line[begin])[::-1]) + rng.uniform(-ASIDE_RAD, ASIDE_RAD)
                world = replace(later(seed, number, rng), start=(x_m, y_m, heading_rad))
                driven = simulate(world, robot, script, seconds=LONGEST_S, seed=100 * seed + number, config=config)
                table.add(seed, f"from {share * length:.0f} m", script.end, *route_row(taught, driven))


if __name__ == "__main__":
    run(goals, routes)
