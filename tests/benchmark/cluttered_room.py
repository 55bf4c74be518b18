"""A room full of things at random places, and an operator who drives through it at random, for `obstacle_stops`.

The corridors of the other cases are driven straight on. Here the base turns, drives backwards, passes between things
and looks for another way where it was stopped, as a person with a stick does who does not watch where the robot is.
"""

from __future__ import annotations

import math
import random
from collections.abc import Iterator, Sequence
from typing import Final

from omnid.core.control.heading_controller import Setpoint, wrap_angle
from omnid.simulation.lockstep import Moment, Request
from omnid.simulation.world import World
from tests.benchmark.floating_boxes import with_floating

Point = tuple[float, float]

CLEAR_M: Final = 0.9  # around the start
APART_M: Final = 0.9  # between the middles of things: some gaps are too narrow for the robot
WALL_TEXTURES: Final = ("brick", "granite", "plaster")
FLOORS: Final = ("tiles", "granite", "brick")
SPEEDS_MPS: Final = (0.3, 0.5, 0.8, -0.4)
# A base that moved and turned by less than this in the time stands: the operator looks for another way.
STANDS_M, STANDS_RAD, STANDS_S = 0.05, 0.1, 1.5
LEG_S: Final = (2.0, 5.0)  # time for which the stick is held
TURN_RAD: Final = math.radians(70.0)  # largest change of the heading from leg to leg


def room_text(case: str, rng: random.Random) -> str:
    """Return a world file: a room with 14 or 15 things on its floor, which is polished where the case says so."""
    x_m, y_m = rng.uniform(2.6, 4.0), rng.uniform(2.4, 3.5)
    places: list[Point] = [(0.0, 0.0)]
    lines = ["schema = 1", f"start = [0.0, 0.0, {rng.uniform(-180, 180)}]", "[space]"]
    lines += [f"low = [{-x_m}, {-y_m}]", f"high = [{x_m}, {y_m}]", f'floor = "{rng.choice(FLOORS)}"']
    lines += ['finish = "polished"'] if case.startswith("polished") else []
    corners = [(-x_m, -y_m), (-x_m, y_m), (x_m, y_m), (x_m, -y_m)]
    for first, last in zip(corners, corners[1:] + corners[:1], strict=True):
        texture, posters = rng.choice(WALL_TEXTURES), rng.choice((0.0, 0.4, 0.8))
        lines += ["[[wall]]", f"points = {[list(first), list(last)]}", f'texture = "{texture}"']
        lines += [f"posters_per_m = {posters}"]
    for kind, count in (("box", 6), ("low box", 3), ("pole", 3), ("plain pole", 2)):
        for _ in range(count + rng.randrange(2) * (kind == "box")):
            at = _place(rng, places, (x_m - 0.5, y_m - 0.5))
            if at is not None:
                lines += ["[[box]]", f"at = {list(at)}", f"yaw_deg = {rng.uniform(-90, 90)}", *_sizes(rng, kind)]
    return "\n".join(lines) + "\n"


def _sizes(rng: random.Random, kind: str) -> list[str]:
    """Return size and texture of a thing."""
    if kind.endswith("pole"):
        side = rng.uniform(0.03, 0.08)
        return [f"size_m = [{side}, {side}, 1.8]", f'texture = "{"white" if kind == "plain pole" else "granite"}"']
    height = 0.08 if kind == "low box" else rng.uniform(0.2, 1.3)
    return [f"size_m = [{rng.uniform(0.2, 0.6)}, {rng.uniform(0.2, 0.6)}, {height}]"]


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

    def __init__(self, seed: int, speeds_mps: Sequence[float] = SPEEDS_MPS) -> None:
        self._rng, self._speeds_mps = random.Random(seed), speeds_mps
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
            self._setpoint = Setpoint(self._rng.choice(self._speeds_mps), heading_rad=heading_rad)
            self._until_s, self._moved_s = moment.time_s + self._rng.uniform(*LEG_S), moment.time_s
        yield self._setpoint
