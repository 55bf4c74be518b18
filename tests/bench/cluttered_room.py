"""Rooms full of things at random places, and an operator who drives through them at random, for `obstacle_stops`.

The corridors of the other cases are driven straight on. Here the base turns, drives backwards, passes between things
and looks for another way where it was stopped, as a person with a stick does who does not watch where the robot is.
"""

from __future__ import annotations

import math
import random
from collections.abc import Iterator, Sequence
from typing import Final

import numpy as np
from numpy.typing import NDArray

from omnid.core.control.heading_controller import Setpoint, wrap_angle
from omnid.simulation.lockstep import Moment, Request
from omnid.simulation.world import World
from tests.bench.floating_boxes import with_floating
from tests.bench.uneven_floors import with_edge

Array = NDArray[np.float64]
Point = tuple[float, float]

CLUTTER, WITH_PEOPLE, AT_EDGE = "clutter", "clutter with people", "clutter at an edge"
ROOMS: Final = (CLUTTER, WITH_PEOPLE, AT_EDGE)

CLEAR_M: Final = 0.9  # around the start
APART_M: Final = 0.9  # between the middles of things: some gaps are too narrow for the robot
WALL_TEXTURES: Final = ("brick", "granite", "plaster")
FLOORS: Final = ("tiles", "granite", "brick")
SPEEDS_MPS: Final = (0.3, 0.5, 0.8, -0.4)
# A base that moved and turned by less than this in the time stands: the operator looks for another way.
STANDS_M, STANDS_RAD, STANDS_S = 0.05, 0.1, 1.5
LEG_S: Final = (2.0, 5.0)  # time for which the stick is held
TURN_RAD: Final = math.radians(70.0)  # largest change of the heading from leg to leg
ABOUT_RAD: Final = math.radians(50.0)  # about a heading towards which the operator often drives
PEOPLE: Final = 2
WALKS_MPS: Final = (0.8, 1.6)
WALK_M: Final = 2.0  # least length of a person's way
WAITS_M: Final = 1.0  # Nearer to the middle of the robot, a person stops, and after some seconds comes half as near.
WALKS_APART_M: Final = 0.6  # of a person's way from the middles of things
DROPS_M: Final = (0.08, 0.15, 0.3, 0.5)
BEYOND_M: Final = 1.5  # from an edge to the wall


def room_text(case: str, rng: random.Random) -> str:
    """Return a world file: a room with 14 or 15 things on its floor, which is polished where the case says so.

    With people, some walk to and fro; at an edge, there is room beyond the things (`lowered`).
    """
    x_m, y_m = rng.uniform(2.6, 4.0), rng.uniform(2.4, 3.5)
    places: list[Point] = [(0.0, 0.0)]
    lines = ["schema = 1", f"start = [0.0, 0.0, {rng.uniform(-180, 180)}]", "[space]"]
    end_m = x_m + BEYOND_M * case.endswith(AT_EDGE)
    lines += [f"low = [{-x_m}, {-y_m}]", f"high = [{end_m}, {y_m}]", f'floor = "{rng.choice(FLOORS)}"']
    lines += ['finish = "polished"'] if case.startswith("polished") else []
    corners = [(-x_m, -y_m), (-x_m, y_m), (end_m, y_m), (end_m, -y_m)]
    for first, last in zip(corners, corners[1:] + corners[:1], strict=True):
        texture, posters = rng.choice(WALL_TEXTURES), rng.choice((0.0, 0.4, 0.8))
        lines += ["[[wall]]", f"points = {[list(first), list(last)]}", f'texture = "{texture}"']
        lines += [f"posters_per_m = {posters}"]
    for kind, count in (("box", 6), ("low box", 3), ("pole", 3), ("plain pole", 2)):
        for _ in range(count + rng.randrange(2) * (kind == "box")):
            at = _place(rng, places, (x_m - 0.5, y_m - 0.5))
            if at is not None:
                lines += ["[[box]]", f"at = {list(at)}", f"yaw_deg = {rng.uniform(-90, 90)}", *_sizes(rng, kind)]
    for _ in range(PEOPLE * case.endswith(WITH_PEOPLE)):
        lines += _person(rng, places[1:], (x_m - 0.4, y_m - 0.4))
    return "\n".join(lines) + "\n"


def _sizes(rng: random.Random, kind: str) -> list[str]:
    """Return size and texture of a thing."""
    if kind.endswith("pole"):
        side = rng.uniform(0.03, 0.08)
        return [f"size_m = [{side}, {side}, 1.8]", f'texture = "{"white" if kind == "plain pole" else "granite"}"']
    height = 0.08 if kind == "low box" else rng.uniform(0.2, 1.3)
    return [f"size_m = [{rng.uniform(0.2, 0.6)}, {rng.uniform(0.2, 0.6)}, {height}]"]


def _person(rng: random.Random, places: Sequence[Point], limits: Point) -> list[str]:
    """Return a person who walks to and fro between two places, apart from things; no lines where no try found a way."""
    for _ in range(200):
        path = [[rng.uniform(-limit, limit) for limit in limits] for _ in range(2)]
        if math.dist(*path) > WALK_M and all(_apart_m(place, *path) > WALKS_APART_M for place in places):
            speed_mps, start_s = rng.uniform(*WALKS_MPS), rng.uniform(3.0, 6.0)
            lines = ["[[person]]", f"path = {path}", f"speed_mps = {speed_mps}", f"start_s = {start_s}"]
            return [*lines, 'repeat = "back and forth"', f"waits_within_m = {WAITS_M}"]
    return []


def _apart_m(point: Point, first: Sequence[float], last: Sequence[float]) -> float:
    """Return the distance of a point from a line between two others."""
    x, y = last[0] - first[0], last[1] - first[1]
    along = ((point[0] - first[0]) * x + (point[1] - first[1]) * y) / (x * x + y * y)
    along = min(max(along, 0.0), 1.0)
    return math.dist(point, (first[0] + along * x, first[1] + along * y))


def lowered(world: World, rng: random.Random) -> tuple[World, Array]:
    """Return a room at an edge with its floor lower beyond the things, and the edge (1, 2, 2)."""
    floor = next(part for part in world.standing if part.name == "floor")
    end_m = floor.origin[0] + floor.edge_u[0]
    return with_edge(world, end_m - BEYOND_M, rng.choice(DROPS_M))


def _place(rng: random.Random, places: list[Point], limits: Point) -> Point | None:
    """Return a place [m] apart from the others, which is added to them; None where no try found one."""
    for _ in range(50):
        at = (rng.uniform(-limits[0], limits[0]), rng.uniform(-limits[1], limits[1]))
        if math.hypot(*at) > CLEAR_M + 0.4 and all(math.dist(at, other) > APART_M for other in places[1:]):
            places.append(at)
            return at
    return None


def furnished(world: World, rng: random.Random) -> World:
    """Return the room with a bar or a table 2 to 3 m along x from the start."""
    return with_floating(world, rng.choice(("bar", "table")), rng)


class Wanderer:
    """Holds the stick in one direction for some seconds, then in another one; turns away where the base stands."""

    def __init__(self, seed: int, towards_rad: float | None = None) -> None:
        """towards_rad: heading in odom about which half of the directions are chosen."""
        self._rng, self._towards_rad = random.Random(seed), towards_rad
        self._until_s, self._setpoint = 0.0, Setpoint(0.5, heading_rad=0.0)
        self._moved_s, self._at, self._heading_rad = 0.0, (0.0, 0.0), 0.0

    def __call__(self, moment: Moment) -> Iterator[Request]:
        """Yield the operator's requests at a moment."""
        if moment.odometry is not None and not moment.controller.armed and moment.time_s < 2.0:
            yield "arm"
        T = moment.T_odom_base
        at, heading_rad = (float(T[0, 3]), float(T[1, 3])), math.atan2(T[1, 0], T[0, 0])
        turned_rad = abs(wrap_angle(heading_rad - self._heading_rad))
        if math.dist(at, self._at) > STANDS_M or turned_rad > STANDS_RAD:
            self._at, self._heading_rad, self._moved_s = at, heading_rad, moment.time_s
        stands = moment.time_s - self._moved_s > STANDS_S
        if moment.time_s >= self._until_s or stands:
            # Where the base stands the way is closed: any direction may be free.
            most_rad = math.pi if stands else TURN_RAD
            heading_rad += self._rng.uniform(-most_rad, most_rad)
            if self._towards_rad is not None and self._rng.random() < 0.5:
                heading_rad = self._towards_rad + self._rng.uniform(-ABOUT_RAD, ABOUT_RAD)
            self._setpoint = Setpoint(self._rng.choice(SPEEDS_MPS), heading_rad=heading_rad)
            self._until_s, self._moved_s = moment.time_s + self._rng.uniform(*LEG_S), moment.time_s
        yield self._setpoint
