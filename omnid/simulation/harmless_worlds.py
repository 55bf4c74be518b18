"""Worlds in which nothing is in the way of what is asked, whatever floor, light and wheels do."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from typing import Final

import numpy as np

from drivers.motors.simulated.simulated_base import Pose
from omnid.errors import OmnidError
from omnid.simulation.building_parts import Builder, Opening, plain_paint
from omnid.simulation.clearance import obstacles_of
from omnid.simulation.people import Person
from omnid.simulation.rendering.shapes import Point
from omnid.simulation.robot import Push, Slip, WheelErrors
from omnid.simulation.trials import BEHIND_M, Trial, built, can_drive, corridor, hall, put_thing, trolley
from omnid.simulation.world import Ground, SunPatch

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
HALL: Final = "_hall"  # ends the name of a floor that is in a hall instead of a corridor
USUAL_WHEELS: Final = WheelErrors()
Make = Callable[[Builder], Trial]


# Straight on, with nothing in the way


def _floor_in_corridor(b: Builder) -> Trial:
    corridor(b)
    return Trial(built(b))


def _floor_in_hall(b: Builder) -> Trial:
    hall(b)
    return Trial(built(b))


def _polished_corridor(b: Builder) -> Trial:
    """Windows in one wall, which the floor mirrors."""
    low, high = (-BEHIND_M, -0.9), (12.0, 0.9)
    b.floor(low, high)
    b.ceiling(low, high)
    b.room(low, high, doors=3, windows=5)
    return Trial(built(b))


def _robot(**changes: object) -> Make:
    """Return what makes a corridor in which the robot is another one."""

    def make(b: Builder) -> Trial:
        corridor(b, width_m=2.2)
        return Trial(built(b), tuple(changes.items()))

    return make


def _lights(*lights: tuple[float, float]) -> Make:
    def make(b: Builder) -> Trial:
        corridor(b)
        return Trial(built(b, lights=lights))

    return make


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
    profile = ((begin_m, 0.0), (begin_m + long_m, top_m))
    return Trial(built(b, ground=Ground(profile)), way_m=7.0)


def _lift_gap(b: Builder) -> Trial:
    """A corridor that ends at a lift, whose floor is another one beyond a gap of 2 cm."""
    at_m, low, high = b.rng.uniform(1.6, 2.2), (-BEHIND_M, -0.9), (0.0, 0.9)
    b.floor(low, (at_m, 0.9))
    b.floor((at_m + 0.02, -0.8), (at_m + 2.3, 0.8), kind="linoleum")
    b.floor((at_m, -0.8), (at_m + 0.02, 0.8), (-0.4, -0.4), "slabs")
    b.ceiling(low, (at_m + 2.3, high[1]))
    b.wall((-BEHIND_M, 0.9), (at_m, 0.9), doors=1, pictures=1)
    b.wall((at_m, -0.9), (-BEHIND_M, -0.9), doors=1)
    b.wall((-BEHIND_M, -0.9), (-BEHIND_M, 0.9))
    for y_m in (0.8, -0.9):  # beside the door of the lift
        b.wall((at_m, y_m + 0.1), (at_m, y_m), skirting=False)
    for a, c in (((at_m, 0.8), (at_m + 2.3, 0.8)), ((at_m + 2.3, 0.8), (at_m + 2.3, -0.8))):
        b.wall(a, c, skirting=False, grey=150.0)
    b.wall((at_m + 2.3, -0.8), (at_m, -0.8), skirting=False, grey=150.0)
    return Trial(built(b), way_m=at_m + 1.0)


def _door_step(b: Builder, height_cm: str) -> Trial:
    """A sill across the way."""
    corridor(b)
    at_m, high_m = b.rng.uniform(1.8, 2.6), float(height_cm) / 100
    b.thing([((0.0, 0.0, 0.0), (0.12, 1.9, high_m))], (at_m, 0.0), 0.0, plain_paint(b.rng, 150.0, 2.0), "floor")
    profile = ((at_m - 0.06, 0.0), (at_m - 0.06, high_m), (at_m + 0.06, high_m), (at_m + 0.06, 0.0))
    return Trial(built(b, ground=Ground(profile)))


def _sun_moving(b: Builder) -> Trial:
    low, high = (-BEHIND_M, -1.0), (12.0, 1.0)
    b.floor(low, high)
    b.ceiling(low, high)
    b.room(low, high, doors=2, windows=5)
    sun = tuple(
        SunPatch(
            (x_m, b.rng.uniform(-0.4, 0.6)),
            (1.3, 0.8),
            b.rng.uniform(-0.4, 0.4),
            (b.rng.uniform(-0.06, 0.06), 0.02),
            0.7,
        )
        for x_m in np.arange(1.5, 10.0, 2.4)
    )
    return Trial(built(b, sun=sun))


def _trolley_leaves(b: Builder) -> Trial:
    """A trolley stands in the way; after a while it is pulled on."""
    _, high = corridor(b, width_m=2.0, length_m=20.0)
    first = len(b.faces)
    b.thing(trolley(b), (0.0, 0.0), 0.0, plain_paint(b.rng, b.rng.uniform(60, 170), 3.0))
    cart, b.faces = tuple(b.faces[first:]), b.faces[:first]
    path = ((2.2, 0.0), (high[0] - 1.2, 0.0))
    start_s = b.rng.uniform(9.0, 11.0)
    return Trial(built(b, people=(Person(cart, path, 0.9, start_s=start_s),)))


def _person_passes(b: Builder) -> Trial:
    """Somebody comes towards the robot, and passes it."""
    corridor(b, width_m=3.0)
    side = float(b.rng.choice([-1, 1]))
    path = ((9.0, side * 0.95), (-1.5, side * 0.95))
    return Trial(built(b, people=(Person(b.adult(), path, b.rng.uniform(0.9, 1.2), start_s=3.0),)))


# To a goal


def _two_rooms(b: Builder, door_m: float, at_y_m: float) -> float:
    """Add two rooms with an open door between them; return where along x the wall with the door is."""
    x_m, low, high = b.rng.uniform(1.8, 2.2), (-1.6, -2.2), (5.6, 2.2)
    b.floor(low, high)
    b.ceiling(low, high)
    b.room(low, high, doors=1, pictures=3)
    b.partition(x_m, (low[1], high[1]), [Opening(high[1] - at_y_m - door_m / 2, door_m)])
    b.shelf((4.4, low[1] + 0.2), math.pi / 2)
    b.table((-0.6, high[1] - 0.5), (1.2, 0.7, 0.74))
    return x_m


def _door(b: Builder, aslant: str) -> Trial:
    """A door of 0.8 m, straight ahead or 30 degrees aside."""
    door_y_m = 0.0 if not aslant else float(b.rng.choice([-1, 1])) * math.tan(math.radians(30.0)) * 2.0
    x_m = _two_rooms(b, 0.8, door_y_m)
    return Trial(built(b), goal=(x_m + 1.8, door_y_m, 0.0))


def _office(b: Builder) -> Trial:
    """Desks with star-legged chairs along both walls, and one chair on the way."""
    low, high = (-1.4, -2.2), (6.2, 2.4)
    b.floor(low, high)
    b.ceiling(low, high)
    b.room(low, high, doors=1, windows=3, pictures=2)
    b.thing([((0.0, 0.0, 0.0), (0.28, 0.28, 0.33))], (0.4, -1.8), 0.0, plain_paint(b.rng, 60.0))
    b.shelf((-1.1, -1.2), 0.0)
    for at_m, y_m in ((1.2, 1.9), (3.6, 1.9), (2.4, -1.75), (5.0, -1.75)):
        x_m, inwards = at_m + b.rng.uniform(-0.2, 0.2), math.copysign(1.0, -y_m)
        b.table((x_m, y_m), (1.4, 0.75, 0.74))
        b.star_chair((x_m + b.rng.uniform(-0.3, 0.3), y_m + inwards * b.rng.uniform(0.5, 0.75)), b.rng.uniform(0, 7))

    def put() -> None:
        b.star_chair((b.rng.uniform(2.2, 3.2), b.rng.uniform(-0.5, 0.5)), b.rng.uniform(0, math.tau))

    return _with_a_way(b, (5.2, 0.2, 0.0), put)


def _clutter(b: Builder) -> Trial:
    """A room full of things, through which a way is left."""
    low, high = (-1.4, -2.4), (5.6, 2.4)
    b.floor(low, high)
    b.ceiling(low, high)
    b.room(low, high, doors=1, windows=2, pictures=1)

    def put() -> None:
        places: list[Point] = []
        for _ in range(60):
            at = float(b.rng.uniform(0.9, 4.0)), float(b.rng.uniform(-2.0, 2.0))
            if len(places) < 8 and all(math.dist(at, other) > 0.85 for other in places):
                places.append(at)
                put_thing(b, str(b.rng.choice(["box", "carton", "chair", "table", "bin"])), at)

    return _with_a_way(b, (4.6, float(b.rng.uniform(-1.0, 1.0)), 0.0), put)


def _with_a_way(b: Builder, goal: Pose, put: Callable[[], None]) -> Trial:
    """Return the trial with things put at random, again and again until a way leads to the goal."""
    empty = len(b.faces)
    for _ in range(200):
        put()
        world = built(b)
        if can_drive(obstacles_of(world, 1.2), (0.0, 0.0), goal[:2]):
            return Trial(world, goal=goal)
        del b.faces[empty:]
    raise OmnidError("no way leads through what was put here 200 times; take another seed")


def _dead_end_and_back(b: Builder) -> Trial:
    """The robot stands in a dead end 1.2 m wide, nose to its end; the goal is in the corridor outside, aside."""
    low, high, end_m = (-3.2, -0.6), (0.75, 3.6), 0.75
    b.floor((low[0], low[1] - 1.0), (end_m, high[1]))
    b.ceiling((low[0], low[1] - 1.0), (end_m, high[1]))
    for a, c in (
        ((-1.4, 0.6), (end_m, 0.6)),  # the dead end, clockwise
        ((end_m, 0.6), (end_m, -0.6)),
        ((end_m, -0.6), (low[0], -0.6)),
        ((low[0], -0.6), (low[0], high[1])),  # the corridor
        ((low[0], high[1]), (-1.4, high[1])),
        ((-1.4, high[1]), (-1.4, 0.6)),
    ):
        b.wall(a, c, doors=int(math.dist(a, c) > 2.0), pictures=int(math.dist(a, c) > 2.0))
    return Trial(built(b), goal=(-2.3, 2.6, math.pi / 2))


def _doorway_with_person(b: Builder) -> Trial:
    """Somebody stands in a door of 0.9 m, sees the robot come, and walks on into its room, and aside."""
    x_m = _two_rooms(b, 0.9, 0.0)
    aside_m = float(b.rng.choice([-1, 1])) * 1.4
    path = ((x_m + 0.1, 0.0), (x_m - 0.5, aside_m * 0.5), (x_m - 0.7, aside_m))
    walker = Person(b.adult(), path, 0.8, start_s=b.rng.uniform(7.0, 9.0))
    return Trial(built(b, people=(walker,)), goal=(x_m + 1.8, 0.0, 0.0))


# By a pattern of names: the kind of the floor, None: one with a pattern, and what makes the trial of a match.
MAKERS: Final[dict[str, tuple[str | None, Callable[..., Trial]]]] = {
    **{name: (kind, _floor_in_corridor) for name, kind in FLOORS.items() if name != "polished"},
    "polished": ("slabs", _polished_corridor),
    **{name + HALL: (kind, _floor_in_hall) for name, kind in FLOORS.items()},
    r"ramp_(\d+)": (None, _ramp),
    "lean_1deg": (None, _robot(lean_rad=(0.0, math.radians(1.0)))),
    "lift_gap": (None, _lift_gap),
    r"door_step_(\d+)cm": (None, _door_step),
    "sun_moving": (None, _sun_moving),
    "light_switch": (None, _lights((6.0, 0.5), (13.0, 1.0))),
    "dark_and_on": (None, _lights((8.0, 0.004), (11.0, 1.0))),
    "pushed": (None, _robot(pushes=(Push(5.0, 5.5, 0.3, 0.15), Push(11.0, 11.5, -0.3, -0.15)))),
    "slip_20": (None, _robot(wheels=replace(USUAL_WHEELS, slips=(Slip(5.0, 7.0, 0.2), Slip(12.0, 14.0, 0.2))))),
    "slip_40": (None, _robot(wheels=replace(USUAL_WHEELS, slips=(Slip(8.0, 10.0, 0.4),)))),
    "weak_motor": (None, _robot(wheels=replace(USUAL_WHEELS, left=USUAL_WHEELS.left - 0.08))),
    "trolley_leaves": (None, _trolley_leaves),
    "person_passes": (None, _person_passes),
    "door_80(_aslant|)": (None, _door),
    "office": (None, _office),
    "clutter": (None, _clutter),
    "dead_end_and_back": (None, _dead_end_and_back),
    "doorway_with_person": (None, _doorway_with_person),
}
NAMES: Final = (
    *FLOORS,
    *(name + HALL for name in FLOORS),
    *("ramp_2", "ramp_5", "ramp_8", "lean_1deg", "lift_gap", "sun_moving", "light_switch", "dark_and_on", "pushed"),
    *("slip_20", "slip_40", "weak_motor", "trolley_leaves", "person_passes"),
    *("door_80", "door_80_aslant", "office", "clutter", "dead_end_and_back", "doorway_with_person"),  # to a goal
)
