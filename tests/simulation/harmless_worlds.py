"""Trials in worlds like buildings in which nothing is in the way of what is asked.

A corridor or hall is along x, and the robot starts at the origin. Whatever floor, light and people do, the way straight
on is free (`Trial.way_m`), or a way leads to the goal (`Trial.goal`).
"""

from __future__ import annotations

import math
import re
import zlib
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import partial
from itertools import pairwise
from typing import Final, Literal, TypeAlias

import cv2
import numpy as np

from calib.models.camera import Array
from drivers.motors.simulated_motor import Pose
from omnid.errors import OmnidError
from omnid.simulation.rendering.surfaces import Point, Rectangle
from omnid.simulation.robot import SimulatedRobot, make_robot
from omnid.simulation.world import Person, Walker
from tests.simulation.building_parts import (
    BEHIND_M,
    Builder,
    Opening,
    corridor,
    hall,
    plain_paint,
    put_thing,
    trolley,
)
from tests.simulation.disturbances import FlawedSensor
from tests.simulation.disturbed import BuildingWorld, Ground, SunPatch, disturbed

# Names of floors, with the kinds of their textures.
FLOORS: Final = {
    "plain": "linoleum",
    "epoxy": "epoxy",
    "marbled": "marbled",
    "concrete": "concrete",
    "carpet": "carpet",
    "tiles": "glazed",
    "parquet_along": "parquet_along",
    "parquet_across": "parquet_across",
    "laminate": "laminate",
    "polished": "slabs",
}
PATTERNED: Final = ("marbled", "carpet", "parquet_across")  # floors of worlds in which something else is tried
FREE_M: Final = 0.36  # from the middle of a base to what stands beside a way that it can surely drive
CELL_M: Final = 0.05
SENSOR: Final = FlawedSensor(vignette=0.25, flicker=0.005, is_compressed=True)
# Rays along a side of an image: with two a pixel and axis at 512 px, joints of tiles come and go from pixel to pixel,
# as no lens shows them; with three they do not.
SIDE_RAYS: Final = 3 * 512


@dataclass(frozen=True, slots=True)
class Trial:
    """A world, the robot in it, and what is asked: the way straight on, or the goal.

    At a hazard, `objects` and the edges of the floor are what must not be touched, and may end the way.
    """

    world: BuildingWorld
    objects: tuple[Rectangle, ...] | None = None  # None: nothing is in the way
    motion: Literal["ahead", "back", "turn left"] = "ahead"  # that is asked for
    changes: tuple[tuple[str, object], ...] = ()  # of fields of the robot
    way_m: float = 8.0  # that is asked for straight on
    goal: Pose | None = None  # x, y [m], heading [rad] in odom, which begins at the start

    def robot(self, size_px: int = 512) -> SimulatedRobot:
        """Return the robot, with images of a size that come as JPEG from a lens with vignetting."""
        usual = replace(make_robot(size_px), sensor=SENSOR, samples=math.ceil(SIDE_RAYS / size_px))
        return disturbed(usual, **dict(self.changes))


# By a pattern of names: the kind of the floor, None: one with a pattern, and what makes the trial of a match.
Makers: TypeAlias = Mapping[str, tuple[str | None, Callable[..., Trial]]]


def made(makers: Makers, name: str, seed: int, floor: str | None = None) -> Trial | None:
    """Return what the first maker whose pattern fits a name makes; None: there is none.

    Same name and seed, same world; floor: another one of FLOORS.
    """
    for pattern, (kind, make) in makers.items():
        if found := re.fullmatch(pattern, name):
            rng = np.random.default_rng([seed, zlib.crc32(name.encode())])
            kind = kind or str(rng.choice(PATTERNED))
            asked = make(Builder(rng, kind if floor is None else FLOORS[floor]), *found.groups())
            return replace(asked, world=replace(asked.world, name=name))
    return None


def built(b: Builder, **fields: object) -> BuildingWorld:
    """Return the world of what was built."""
    polished = {"is_polished": b.floor_kind == "slabs"}
    return BuildingWorld("", tuple(b.faces), panes=tuple(b.panes), **(polished | fields))  # type: ignore[arg-type]


# Straight on


def _floor(b: Builder, *, in_hall: bool = False) -> Trial:
    (hall if in_hall else corridor)(b)
    return Trial(built(b))


def _narrow(b: Builder) -> Trial:
    """A corridor whose walls are nearer than the floor in view."""
    corridor(b, width_m=b.rng.uniform(1.2, 1.4))
    return Trial(built(b))


def _polished_corridor(b: Builder) -> Trial:
    """Windows in one wall, which the floor mirrors."""
    b.space((-BEHIND_M, -0.9), (12.0, 0.9), doors=3, windows=5)
    return Trial(built(b))


def _lights(b: Builder, *lights: Point) -> Trial:
    corridor(b)
    return Trial(built(b, lights=lights))


def _ramp(b: Builder, degrees: str) -> Trial:
    """A level metre, a ramp up, and a landing."""
    slope, begin_m, long_m = math.tan(math.radians(float(degrees))), b.rng.uniform(1.4, 2.0), 4.0
    top_m, low, high = slope * long_m, (-BEHIND_M, -0.9), (11.0, 0.9)
    b.ceiling_m = 2.6 + top_m
    b.floor(low, (begin_m, high[1]))
    b.floor((begin_m, low[1]), (begin_m + long_m, high[1]), (0.0, top_m))
    b.floor((begin_m + long_m, low[1]), high, (top_m, top_m))
    b.ceiling(low, high)
    b.room(low, high, doors=0, pictures=4)
    return Trial(built(b, ground=Ground(((begin_m, 0.0), (begin_m + long_m, top_m)))), way_m=7.0)


def _lift_gap(b: Builder) -> Trial:
    """A corridor that ends at a lift, whose floor is another one beyond a gap of 2 cm."""
    at_m, low = b.rng.uniform(1.6, 2.2), (-BEHIND_M, -0.9)
    end_m = at_m + 2.3
    b.floor(low, (at_m, 0.9))
    b.floor((at_m + 0.02, -0.8), (end_m, 0.8), kind="linoleum")
    b.floor((at_m, -0.8), (at_m + 0.02, 0.8), (-0.4, -0.4), "slabs")
    b.ceiling(low, (end_m, 0.9))
    b.wall((-BEHIND_M, 0.9), (at_m, 0.9), doors=1, pictures=1)
    b.wall((at_m, -0.9), (-BEHIND_M, -0.9), doors=1)
    b.wall((-BEHIND_M, -0.9), (-BEHIND_M, 0.9))
    for y_m in (0.8, -0.9):  # beside the door of the lift
        b.wall((at_m, y_m + 0.1), (at_m, y_m), skirting=False)
    corners = ((at_m, 0.8), (end_m, 0.8), (end_m, -0.8), (at_m, -0.8))
    for a, c in pairwise(corners):
        b.wall(a, c, skirting=False, grey=150.0)
    return Trial(built(b), way_m=at_m + 1.0)


def _sun_moving(b: Builder) -> Trial:
    b.space((-BEHIND_M, -1.0), (12.0, 1.0), doors=2, windows=5)
    sun = []
    for x_m in np.arange(1.5, 10.0, 2.4):
        at, yaw_rad = (x_m, b.rng.uniform(-0.4, 0.6)), b.rng.uniform(-0.4, 0.4)
        sun.append(SunPatch(at, (1.3, 0.8), yaw_rad, (b.rng.uniform(-0.06, 0.06), 0.02), 0.7))
    return Trial(built(b, sun=tuple(sun)))


def _trolley_leaves(b: Builder) -> Trial:
    """A trolley stands in the way; after a while it is pulled on."""
    _, high = corridor(b, width_m=2.0, length_m=20.0)
    first = len(b.faces)
    b.object(trolley(b), (0.0, 0.0), 0.0, plain_paint(b.rng, b.rng.uniform(60, 170), 3.0))
    cart, b.faces = tuple(b.faces[first:]), b.faces[:first]
    path = ((2.2, 0.0), (high[0] - 1.2, 0.0))
    return Trial(built(b, people=(Person(cart, Walker(path, 0.9, start_s=b.rng.uniform(9.0, 11.0))),)))


def _person_passes(b: Builder) -> Trial:
    """Somebody comes towards the robot, and passes it."""
    corridor(b, width_m=3.0)
    side = float(b.rng.choice([-1, 1]))
    path = ((9.0, side * 0.95), (-1.5, side * 0.95))
    return Trial(built(b, people=(Person(b.adult(), Walker(path, b.rng.uniform(0.9, 1.2), start_s=3.0)),)))


def _person_comes(b: Builder) -> Trial:
    """Somebody comes up to the robot, stands before it for some seconds, from foot to foot, and goes back."""
    _, high = corridor(b, width_m=2.0, length_m=20.0)
    at_m = b.rng.uniform(1.4, 1.6)
    stands = ((at_m + 0.02 * (k % 2), 0.0) for k in range(180))
    path = ((5.0, 0.0), *stands, (high[0] - 1.2, 0.0))
    return Trial(built(b, people=(Person(b.adult(), Walker(path, 0.9, start_s=1.0)),)))


# To a goal


def _two_rooms(b: Builder, door_m: float, at_y_m: float) -> float:
    """Add two rooms with an open door between them; return where along x the wall with the door is."""
    x_m, low, high = b.rng.uniform(1.8, 2.2), (-1.6, -2.2), (5.6, 2.2)
    b.space(low, high, doors=1, pictures=3)
    b.partition(x_m, (low[1], high[1]), [Opening(high[1] - at_y_m - door_m / 2, door_m)])
    b.shelf((4.4, low[1] + 0.2), math.pi / 2)
    b.table((-0.6, high[1] - 0.5), (1.2, 0.7, 0.74))
    return x_m


def _door(b: Builder, kind: str) -> Trial:
    """A door of 0.8 m, straight ahead or 30 degrees aside, or with a chair before it and two behind."""
    door_y_m = 0.0 if kind != "_aslant" else float(b.rng.choice([-1, 1])) * math.tan(math.radians(30.0)) * 2.0
    wall_m = _two_rooms(b, 0.8, door_y_m)
    for x_m, y_m in ((-0.9, -0.75), (0.9, 0.8), (1.4, -0.6)) if kind == "_chairs" else ():
        b.star_chair((wall_m + x_m, y_m), b.rng.uniform(0, math.tau))
    return Trial(built(b), goal=(wall_m + 1.8, door_y_m, 0.0))


def _office(b: Builder) -> Trial:
    """Desks with star-legged chairs along both walls, and one chair on the way."""
    b.space((-1.4, -2.2), (6.2, 2.4), doors=1, windows=3, pictures=2)
    b.object([(0.0, 0.0, 0.0, 0.28, 0.28, 0.33)], (0.4, -1.8), 0.0, plain_paint(b.rng, 60.0))
    b.shelf((-1.1, -1.2), 0.0)
    for at_m, y_m in ((1.2, 1.9), (3.6, 1.9), (2.4, -1.75), (5.0, -1.75)):
        x_m, inwards = at_m + b.rng.uniform(-0.2, 0.2), math.copysign(1.0, -y_m)
        b.table((x_m, y_m), (1.4, 0.75, 0.74))
        b.star_chair((x_m + b.rng.uniform(-0.3, 0.3), y_m + inwards * b.rng.uniform(0.5, 0.75)), b.rng.uniform(0, 7))

    def put() -> None:
        b.star_chair((b.rng.uniform(2.2, 3.2), b.rng.uniform(-0.5, 0.5)), b.rng.uniform(0, math.tau))

    return _with_a_way(b, (5.2, 0.2, 0.0), put)


def _clutter(b: Builder) -> Trial:
    """A room full of objects, through which a way is left."""
    b.space((-1.4, -2.4), (5.6, 2.4), doors=1, windows=2, pictures=1)

    def put() -> None:
        places: list[Point] = []
        for _ in range(60):
            at = float(b.rng.uniform(0.9, 4.0)), float(b.rng.uniform(-2.0, 2.0))
            if len(places) < 8 and all(math.dist(at, other) > 0.85 for other in places):
                places.append(at)
                put_thing(b, str(b.rng.choice(["box", "carton", "chair", "table", "bin"])), at)

    return _with_a_way(b, (4.6, float(b.rng.uniform(-1.0, 1.0)), 0.0), put)


def _with_a_way(b: Builder, goal: Pose, put: Callable[[], None]) -> Trial:
    """Return the trial with objects put at random, again and again until a way leads to the goal."""
    empty = len(b.faces)
    for _ in range(200):
        put()
        world = built(b)
        if can_drive(world.obstacles(1.2), (0.0, 0.0), goal[:2]):
            return Trial(world, goal=goal)
        del b.faces[empty:]
    raise OmnidError("no way leads through what was put here 200 times; take another seed")


def can_drive(segments: Array, start: Point, goal: Point) -> bool:
    """Return whether a way leads from start to goal that is nowhere nearer than FREE_M to segments (N, 2, 2)."""
    points = np.concatenate([segments.reshape(-1, 2), [start, goal]])
    low = points.min(axis=0) - 1.0
    width, height = np.ceil((points.max(axis=0) + 1.0 - low) / CELL_M).astype(int).tolist()
    free = np.full((height, width), 255, np.uint8)
    for ends in np.rint((segments - low) / CELL_M).astype(int):
        cv2.line(free, ends[0].tolist(), ends[1].tolist(), 0)
    wide = cv2.distanceTransform(free, cv2.DIST_L2, 5) * CELL_M > FREE_M
    _, parts = cv2.connectedComponents(wide.astype(np.uint8), connectivity=4)
    at = [parts[tuple(np.rint((np.array(place) - low) / CELL_M).astype(int)[::-1])] for place in (start, goal)]
    return bool(at[0] and at[0] == at[1])


def _dead_end_and_back(b: Builder) -> Trial:
    """The robot stands in a dead end 1.2 m wide, nose to its end; the goal is in the corridor outside, aside."""
    left_m, end_m, top_m = -3.2, 0.75, 3.6
    b.floor((left_m, -1.6), (end_m, top_m))
    b.ceiling((left_m, -1.6), (end_m, top_m))
    # The dead end, clockwise, then the corridor.
    corners = ((-1.4, 0.6), (end_m, 0.6), (end_m, -0.6), (left_m, -0.6), (left_m, top_m), (-1.4, top_m), (-1.4, 0.6))
    for a, c in pairwise(corners):
        b.wall(a, c, doors=int(math.dist(a, c) > 2.0), pictures=int(math.dist(a, c) > 2.0))
    return Trial(built(b), goal=(-2.3, 2.6, math.pi / 2))


def _doorway_with_person(b: Builder) -> Trial:
    """Somebody stands in a door of 0.9 m, sees the robot come, and walks on into its room, and aside."""
    x_m = _two_rooms(b, 0.9, 0.0)
    aside_m = float(b.rng.choice([-1, 1])) * 1.4
    path = ((x_m + 0.1, 0.0), (x_m - 0.5, aside_m * 0.5), (x_m - 0.7, aside_m))
    walker = Person(b.adult(), Walker(path, 0.8, start_s=b.rng.uniform(7.0, 9.0)))
    return Trial(built(b, people=(walker,)), goal=(x_m + 1.8, 0.0, 0.0))


MAKERS: Final[Makers] = {
    **{name: (kind, _floor) for name, kind in FLOORS.items() if name != "polished"},
    "polished": ("slabs", _polished_corridor),
    **{f"{name}_hall": (kind, partial(_floor, in_hall=True)) for name, kind in FLOORS.items()},
    "narrow": (None, _narrow),
    r"ramp_(\d+)": (None, _ramp),
    "lift_gap": (None, _lift_gap),
    "sun_moving": (None, _sun_moving),
    "light_switch": (None, lambda b: _lights(b, (6.0, 0.5), (13.0, 1.0))),
    "dark_and_on": (None, lambda b: _lights(b, (8.0, 0.004), (11.0, 1.0))),
    "trolley_leaves": (None, _trolley_leaves),
    "person_passes": (None, _person_passes),
    "person_comes": (None, _person_comes),
    "door_80(_aslant|_chairs|)": (None, _door),
    "office": (None, _office),
    "clutter": (None, _clutter),
    "dead_end_and_back": (None, _dead_end_and_back),
    "doorway_with_person": (None, _doorway_with_person),
}
NAMES: Final = (
    *FLOORS,
    *(f"{name}_hall" for name in FLOORS),
    *("ramp_2", "ramp_5", "ramp_8", "lift_gap", "sun_moving", "light_switch", "dark_and_on"),
    *("trolley_leaves", "person_passes", "person_comes", "narrow"),
    *("door_80", "door_80_aslant", "office", "clutter", "dead_end_and_back", "doorway_with_person"),  # to a goal
)
