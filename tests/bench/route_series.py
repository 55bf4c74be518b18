"""A route taught once and repeated: `python -m tests.bench.route_series [--seeds 20 21] [--length 33]`.

In the corridor around the rooms of `building` somebody drives a round of 33 m, or its first metres, while map and route
are recorded. The route is then repeated in the saved map from other starts on it, with other light, a fifth of the
posters exchanged, and two people who walk across the corridor and wait for a near robot. A row for each drive: its end,
cross-track error of the true path against the true path of the lesson (p95 with and without detours around obstacles
and the metre after them), distance to the lesson's end, way, contacts, least clearance, and why it stood.
"""

from __future__ import annotations

import math
import random
import tempfile
import time
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray

from omnid.config import Config, load_config
from omnid.core.control.heading_controller import Setpoint
from omnid.core.navigation.requests import RouteAction, RouteRequest
from omnid.navigation_state import NavigationState
from omnid.simulation.demonstration import ANSWER_S, cross_track_m
from omnid.simulation.lockstep import Moment, Request, SimulatedRun, simulate
from omnid.simulation.robot import SimulatedRobot
from omnid.simulation.vehicle import START_NS
from omnid.simulation.world import World
from omnid.simulation.world_file import WorldOptions, load_world
from omnid.tracking_state import MapState
from tests.bench.fine_robot import fine_robot
from tests.bench.results import Cell, ResultTable, columns, run

Array = NDArray[np.float64]
WORLD: Final = "building"
ROUTE: Final = "round"
CORNERS: Final = np.array([(11.05, 1.05), (11.05, 7.95), (0.95, 7.95), (0.95, 1.05)])  # m; 0.5 m free beside the robot
START: Final = (6.0, 1.05)
RADIUS_M: Final = 0.6  # of the corners
SPACING_M: Final = 0.05
SPEED_MPS, SEEK_MPS, AHEAD_M = 0.4, 0.2, 0.45  # of the person who drives
STARTS: Final = (0.0, 0.3, 0.12, 0.6, 0.45)  # share of the way at which the repetitions begin
ASIDE_M, ASIDE_RAD = 0.1, math.radians(10)  # largest offset of a start from the route
LONGEST_S: Final = 240.0
UNRECOGNISED_S: Final = 20.0  # of driving, after which the repetition is given up
STOPPING_S: Final = 1.0  # at the end of the lesson
SETTLED_M: Final = 1.0  # way after which a repetition has come from its start to the route
DOORS: Final = (((8.42, 4.3), (8.42, 0.6)), ((4.95, 2.4), (4.95, 8.4)))  # ways of the people, from rooms


def lap(length_m: float) -> Array:
    """Return the first metres of the round (N, 2) [m] in the world, its corners rounded off."""
    points = [START]
    for before, corner, after in zip(np.roll(CORNERS, 1, axis=0), CORNERS, np.roll(CORNERS, -1, axis=0), strict=True):
        u, v = (np.sign(other - corner) for other in (before, after))  # the sides are along the axes
        points += [
            tuple(corner + RADIUS_M * (u * (1 - math.sin(t)) + v * (1 - math.cos(t))))
            for t in np.linspace(0.0, math.pi / 2, 15)
        ]
    corners = np.array([*points, START])
    way_m = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(corners, axis=0), axis=1))])
    at_m = np.arange(0.0, min(length_m, way_m[-1]), SPACING_M)
    return np.column_stack([np.interp(at_m, way_m, corners[:, axis]) for axis in (0, 1)])


class Driver:
    """A person who sees where the robot is: pure pursuit of a line (N, 2) in the world by the true pose."""

    def __init__(self, line: Array, begin: int = 0) -> None:
        self._line, self._at = line, begin

    def setpoint(self, T_world_base: Array, velocity_mps: float) -> Setpoint | None:
        """Return what is wanted of the wheels; None at the end of the line."""
        near = self._line[self._at : self._at + 40]
        self._at += int(np.argmin(np.linalg.norm(near - T_world_base[:2, 3], axis=1)))
        if self._at >= len(self._line) - 2:
            return None
        aim = self._line[min(self._at + round(AHEAD_M / SPACING_M), len(self._line) - 1)]
        _, y_m = T_world_base[:2, :2].T @ (aim - T_world_base[:2, 3])
        curvature = 2.0 * y_m / max(float(np.sum((aim - T_world_base[:2, 3]) ** 2)), 0.04)
        return Setpoint(velocity_mps, yaw_rate_radps=velocity_mps * curvature)


class Lesson:
    """The script of the lesson: somebody drives along a line and has it recorded."""

    def __init__(self, line: Array) -> None:
        self._driver, self._taught = Driver(line), False
        self._stood_s = self._finished_s = math.inf
        self.end = ""

    def __call__(self, moment: Moment) -> Iterator[Request]:
        """Drive on; stop at the end of the line and finish the route."""
        if moment.place is None:
            return
        if not moment.controller.armed:
            yield "arm"
            return
        answer = None if moment.navigation is None else moment.navigation.answer
        if (answer is not None and answer.refusal) or moment.time_s > self._finished_s + ANSWER_S:
            self.end = "taught" if answer is None else answer.refusal or "taught"
            yield "end"
            return
        if not self._taught:
            self._taught = True
            yield RouteRequest(RouteAction.TEACH, ROUTE)
        setpoint = self._driver.setpoint(moment.T_world_base, SPEED_MPS)
        yield setpoint or Setpoint(0.0)
        if setpoint is None:
            self._stood_s = min(self._stood_s, moment.time_s)
            if moment.time_s > self._stood_s + STOPPING_S and math.isinf(self._finished_s):
                self._finished_s = moment.time_s
                yield RouteRequest(RouteAction.FINISH)


class Repetition:
    """A script: somebody drives slowly until the robot knows where it is, then it is asked to repeat the route."""

    def __init__(self, line: Array, begin: int) -> None:
        """line: (N, 2) [m] in the world, driven by hand from point number begin on."""
        self._driver, self._asked_s = Driver(line, begin), math.inf
        self.end = ""

    def __call__(self, moment: Moment) -> Iterator[Request]:
        """Ask, and wait for the end."""
        if moment.place is None or not moment.controller.armed:
            if moment.place is not None and math.isinf(self._asked_s):
                yield "arm"
            return
        if math.isinf(self._asked_s):
            if moment.place.state is MapState.LOCALIZED:
                self._asked_s = moment.time_s
                yield Setpoint(0.0)
                yield RouteRequest(RouteAction.REPEAT, ROUTE)
            elif moment.time_s > UNRECOGNISED_S:
                self.end = "not recognised"
                yield "end"
            else:
                yield self._driver.setpoint(moment.T_world_base, SEEK_MPS) or Setpoint(0.0)
            return
        navigation = moment.navigation
        if navigation is not None and moment.time_s > self._asked_s + ANSWER_S:
            refusal = "" if navigation.answer is None else navigation.answer.refusal
            if refusal or navigation.state.is_end:
                self.end = f"refused: {refusal}" if refusal else f"{navigation.state} {navigation.reason}".strip()
                yield "end"


def changed_world(seed: int, number: int, rng: random.Random, people: bool) -> World:
    """Return the building at a later time of the day."""
    options = WorldOptions(brightness=rng.uniform(0.6, 1.3), other_posters=0.2, posters_seed=number + 1)
    person = load_world("corridor").people[0]
    walking = tuple(
        replace(
            person,
            path=path,
            speed_mps=rng.uniform(0.6, 1.0),
            start_s=rng.uniform(0.0, 10.0),
            repeat="back and forth",
            waits_within_m=1.0,
        )
        for path in DOORS
    )
    return replace(load_world(WORLD, seed, options), people=walking if people else ())


def row(lesson: Array, driven: SimulatedRun, end: str) -> list[Cell]:
    """Return the figures of a drive against the true positions (N, 2) of the lesson."""
    path = np.array([tick.pose[:2] for tick in driven.ticks])
    way_m = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(path, axis=0), axis=1))])
    repeated = way_m > SETTLED_M
    off_cm = 100 * cross_track_m(lesson, path)
    on_path = repeated & ~on_detour(driven, way_m)
    waits = dict.fromkeys(
        f"{update.state}: {update.reason}" for update in driven.navigation if update.reason and not update.state.is_end
    )
    waits |= dict.fromkeys(line for _, line in driven.lines if line.startswith("the wheels stop"))
    avoided_s = sum(update.state is NavigationState.AVOIDING for update in driven.navigation) * 0.1
    p95, most = (np.percentile(off_cm[repeated], 95), off_cm[repeated].max()) if repeated.any() else (None, None)
    without = np.percentile(off_cm[on_path], 95) if on_path.any() else None
    end_error_cm = 100 * math.dist(path[-1], lesson[-1])
    return [
        end,
        p95,
        without,
        most,
        avoided_s,
        end_error_cm,
        float(way_m[-1]),
        driven.ticks[-1].time_s,
        len(driven.contacts),
        driven.clearance_m,
        "; ".join(waits)[:300],
    ]


def on_detour(driven: SimulatedRun, way_m: Array) -> NDArray[np.bool_]:
    """Return True (N,) at the ticks of a drive on the way around an obstacle, and SETTLED_M after it."""
    states_ns = np.array([update.stamp_ns - START_NS for update in driven.navigation], np.int64)
    avoids = np.array([False, *(update.state is NavigationState.AVOIDING for update in driven.navigation)])
    times_ns = np.array([tick.time_s for tick in driven.ticks]) * 1e9
    now = avoids[np.searchsorted(states_ns, times_ns, side="right")]
    last_m = np.maximum.accumulate(np.where(now, way_m, -np.inf))
    return np.asarray(way_m - last_m <= SETTLED_M)


def series(seed: int, length_m: float, repeats: int, robot: SimulatedRobot, people: bool) -> Iterator[list[Cell]]:
    """Teach a route and repeat it; yield a row for each drive."""
    line = lap(length_m)
    with tempfile.TemporaryDirectory() as folder:
        config: Config = load_config(
            None, [f"places.map={Path(folder) / 'building.omap'}", f"navigation.routes={Path(folder) / 'routes'}"]
        )
        world = replace(load_world(WORLD, seed), start=(*START, 0.0))
        started_s, lesson = time.process_time(), Lesson(line)
        driven = simulate(world, robot, lesson, seconds=LONGEST_S, seed=seed, config=config)
        taught = np.array([tick.pose[:2] for tick in driven.ticks])
        yield [seed, "lesson", *row(taught, driven, lesson.end or "time is over"), time.process_time() - started_s]
        for number in range(repeats):
            rng, started_s = random.Random(1000 * seed + number), time.process_time()
            begin = round(STARTS[number] * len(line))
            (x, y), (ahead_x, ahead_y) = line[begin], line[begin + 2]
            start = (
                x + rng.uniform(-ASIDE_M, ASIDE_M),
                y + rng.uniform(-ASIDE_M, ASIDE_M),
                math.atan2(ahead_y - y, ahead_x - x) + rng.uniform(-ASIDE_RAD, ASIDE_RAD),
            )
            world = replace(changed_world(seed, number, rng, people), start=start)
            script = Repetition(line, begin)
            driven = simulate(world, robot, script, seconds=LONGEST_S, seed=100 * seed + number, config=config)
            yield [
                seed,
                f"from {STARTS[number] * SPACING_M * len(line):.0f} m",
                *row(taught, driven, script.end or "time is over"),
                time.process_time() - started_s,
            ]


def route_series(
    *,
    seeds: Sequence[int] = (1,),
    length: float = 33.0,
    repeats: int = len(STARTS),
    size: int = 512,
    no_people: bool = False,
) -> None:
    """Print a row for each drive on a route of so many metres."""
    head = columns(
        *("seed", "drive", "end", "off the lesson p95|cm|1", "p95 without detours|cm|1", "most|cm|1"),
        *("around obstacles|s|0", "end error|cm|1", "way|m|1", "time|s|0", "contacts", "clearance|m|2"),
        *("stood or slowed", "processor time|s|0"),
    )
    table = ResultTable("route_series", f"Repeated route of {length:g} m", head)
    for seed in seeds:
        for cells in series(seed, length, min(repeats, len(STARTS)), fine_robot(size), not no_people):
            table.add(*cells, seed=("route", seed))


if __name__ == "__main__":
    run(route_series)
