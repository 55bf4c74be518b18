"""Trials: a world like a building, the robot in it, and what is asked of it: `trial(name, seed)`.

In the harmless worlds nothing is in the way of what is asked. In the hazards something is: on the floor, over it, below
it, moving, or nearer than the view, about 2 to 3 m ahead, a little beside the way.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from typing import Final

import numpy as np

from omnid.errors import OmnidError
from omnid.simulation.rendering.surfaces import Paint, Point, Rectangle, painted, solid
from omnid.simulation.robot import SimulatedRobot
from omnid.simulation.world import Person, Walker, moved
from tests.simulation import harmless_worlds
from tests.simulation.building_parts import (
    BEHIND_M,
    THING_PX_PER_M,
    Builder,
    Opening,
    Part,
    corridor,
    four_legs,
    plain_paint,
    poster_paint,
    trolley,
)
from tests.simulation.disturbed import Ground, Push, Slip
from tests.simulation.harmless_worlds import Makers, Trial, built, made

PRINTED: Final = ("box", "low_box", "block", "shelf", "drawer", "table")  # objects with pictures on them
LENGTH_M: Final = 12.0
WALKER_MPS: Final = 0.5  # of the robot whose way people cross


def trial(name: str, seed: int, floor: str | None = None) -> Trial:
    """Return the trial of a name: same name and seed, same world; floor: another one of FLOORS."""
    if (found := made(MAKERS, name, seed, floor)) is None:
        raise OmnidError(f"world {name!r} is not known; the worlds are {', '.join((*HARMLESS, *HAZARDS))}")
    return found


# Objects on the floor, or over it, from the middle of what is in the way: their parts, each drawn by `u` from a range,
# and the largest angle by which they are turned [deg].
Draw = Callable[[float, float], float]
OBJECTS: Final[dict[str, tuple[Callable[[Draw], list[Part]], float]]] = {
    "box": (lambda u: [(0, 0, 0, u(0.25, 0.6), u(0.25, 0.6), u(0.4, 1.2))], 40),
    "low_box": (lambda u: [(0, 0, 0, u(0.25, 0.6), u(0.25, 0.6), 0.08)], 40),
    "block": (lambda u: [(0, 0, 0, u(0.25, 0.5), u(0.25, 0.5), u(0.15, 0.6))], 90),
    "pole": (lambda u: [(0, 0, 0, side := u(0.03, 0.08), side, 1.8)], 40),
    "leg": (lambda u: [(0, 0, 0, 0.03, 0.03, 0.7), (0, 0.35, 0.7, 0.5, 0.8, 0.03)], 15),
    "bar": (lambda u: [(0, 0, u(0.12, 1.1), 0.03, 1.4, 0.03)], 0),
    "bar_end_on": (lambda u: [(0.7, 0, u(0.12, 1.1), 1.4, 0.04, 0.04)], 0),
    "table": (
        lambda u: [*four_legs((0.76 / 2, 0.56 / 2), 0.04, top := u(0.6, 0.8)), (0, 0, top, 0.8, 0.6, 0.04)],
        0,
    ),
    # Of a fork lift.
    "tines": (
        lambda u: [
            (1.3, 0, 0, 0.6, 0.9, 1.1),
            *((0.5, y, low, 1.0, 0.12, 0.06) for low in [u(0.04, 0.1)] for y in (0.25, -0.25)),
        ],
        0,
    ),
    "chair": (
        lambda u: [
            *four_legs((0.2, 0.2), 0.03, seat := u(0.4, 0.48)),
            (0, 0, seat, 0.42, 0.42, 0.03),
            *((-0.2, y, seat, 0.03, 0.03, 0.5) for y in (0.2, -0.2)),
            *((-0.2, 0, z, 0.02, 0.42, 0.06) for z in (0.6, 0.75, 0.88)),
        ],
        180,
    ),
    "stool": (
        lambda u: [*four_legs((0.14, 0.14), 0.025, high := u(0.45, 0.75)), (0, 0, high, 0.33, 0.33, 0.03)],
        45,
    ),
    "ladder": (
        lambda u: [
            *four_legs((0.3, (wide := u(0.4, 0.55)) / 2), 0.04, 1.6),
            *((-0.3, 0, 0.28 * (n + 1), 0.03, wide, 0.03) for n in range(5)),
        ],
        180,
    ),
    # Two posts and a belt between them, which is what is in the way.
    "barrier": (
        lambda u: [
            *((0, y, 0, 0.05, 0.05, 0.95) for y in (0.75, -0.75)),
            (0, 0, u(0.7, 0.9), 0.005, 1.5, 0.05),
        ],
        20,
    ),
    "pallet": (
        lambda u: [
            *((0, y, 0, 1.2, 0.1, 0.11) for y in (-0.35, 0.0, 0.35)),
            *((x, 0, 0.11, 0.12, 0.8, 0.02) for x in (-0.54, -0.27, 0.0, 0.27, 0.54)),
            *([(0, 0, 0.13, 0.9, 0.7, 0.4)] if u(0.0, 1.0) < 0.3 else []),
        ],
        90,
    ),
    "open_door": (lambda u: [(0, 0, 0.005, u(0.7, 0.9), 0.04, 2.0)], 25),
    # A cabinet beside the way, and a drawer that stands out of it into the way.
    "drawer": (lambda u: [(0, 0.95, 0, 0.5, 0.6, 1.2), (0, 0.35, u(0.3, 0.8), 0.45, 0.6, 0.18)], 10),
    "lying_person": (lambda u: [(0, 0, 0, 0.4, 1.1, u(0.18, 0.24)), (0, 0.7, 0, 0.2, 0.2, 0.2)], 90),
    "stairs_up": (lambda u: [(0.3 * n, 0, 0.16 * n, 0.3, 1.2, 0.16) for n in range(5)], 15),
    "shelf": (
        lambda u: [
            *four_legs((0.32 / 2, 0.87 / 2), 0.025, 1.75),
            *((0, 0, z, 0.35, 0.9, 0.02) for z in (u(0.3, 0.4), 0.8, 1.25, 1.7)),
        ],
        90,
    ),
    "hose_5cm": (lambda u: [(0, 0, 0, 0.05, 1.6, 0.05)], 25),
    # The charging station of a robot: a plate of 3 cm, and a back.
    "dock": (lambda u: [(0, 0, 0, 0.4, 0.4, 0.03), (0.22, 0, 0, 0.06, 0.4, 0.3)], 20),
}


def _wide_corridor(b: Builder) -> None:
    corridor(b, width_m=b.rng.uniform(2.2, 3.0), length_m=LENGTH_M + BEHIND_M)


def _hazard(b: Builder, first: int, **fields: object) -> Trial:
    """Return the trial in which what was built since a number of faces is in the way."""
    return Trial(built(b, **fields), objects=tuple(b.faces[first:]))


def _place(b: Builder) -> Point:
    return b.rng.uniform(2.2, 3.0), b.rng.uniform(-0.15, 0.15)


def kind_paint(rng: np.random.Generator, kind: str) -> Paint:
    """Return what paints a face by a kind of texture (textures.PAINTERS)."""
    return lambda sides_m: painted(rng, kind, sides_m, THING_PX_PER_M)


def _put(b: Builder, name: str, paint: Paint, at: Point) -> None:
    """Add an object whose nearest part is at a place, turned at random."""
    parts_of, most_deg = OBJECTS.get(name, (lambda _: trolley(b), 180))
    yaw_rad = math.radians(b.rng.uniform(-most_deg, most_deg))
    first = len(b.faces)
    b.object(parts_of(b.rng.uniform), (0.0, 0.0), yaw_rad, paint)
    nearest_m = min(float(face.corners[:, 0].min()) for face in b.faces[first:])
    shift = np.array([at[0] - nearest_m, at[1], 0.0])
    b.faces[first:] = [replace(face, origin=face.origin + shift) for face in b.faces[first:]]


def _object(b: Builder, plain: str, name: str) -> Trial:
    _wide_corridor(b)
    first = len(b.faces)
    if plain:
        paint = plain_paint(b.rng, b.rng.uniform(60, 230))
    elif name in PRINTED:
        paint = poster_paint(b.rng)
    else:
        paint = kind_paint(b.rng, str(b.rng.choice(["granite", "plaster"])))
    _put(b, name, paint, _place(b))
    return _hazard(b, first)


def _contrast(b: Builder, name: str, percent: str) -> Trial:
    """An object, or a drop of 15 cm, whose grey as it is seen differs from the floor's by so many per cent."""
    share = 1 + float(b.rng.choice([-1, 1])) * float(percent) / 100
    if name == "edge":
        return _edge(b, "15", share)
    _wide_corridor(b)
    first, floor = len(b.faces), b.faces[0]
    _put(b, name, plain_paint(b.rng, 100.0), _place(b))
    grey = share * float(floor.texture.mean()) * floor.brightness
    b.faces[first:] = [_in_grey(face, grey) for face in b.faces[first:]]
    return _hazard(b, first)


def _in_grey(face: Rectangle, grey: float) -> Rectangle:
    """Return a face that is seen in one grey, under the light on it."""
    return replace(face, texture=np.full_like(face.texture, np.clip(round(grey / face.brightness), 0, 255)))


# What the floor does


def _edge(b: Builder, drop_cm: str, share: float | None = None, stairs: int = 1) -> Trial:
    """A corridor whose floor falls, by steps of which each is 0.28 m long; share: of the grey below."""
    at_m, half_m, drop_m = b.rng.uniform(2.0, 3.0), b.rng.uniform(1.1, 1.5), float(drop_cm) / 100
    low, high = (-BEHIND_M, -half_m), (LENGTH_M, half_m)
    b.floor(low, (at_m, half_m))
    profile, x_m = [(at_m, 0.0)], at_m
    for step in range(stairs):
        z_m, end_m = -(step + 1) * drop_m, x_m + 0.28 if step + 1 < stairs else high[0]
        before = b.faces[0].texture
        b.floor((x_m, -half_m), (end_m, half_m), (z_m, z_m))
        if share is not None:
            value = np.clip(round(share * float(before.mean())), 0, 255)
            b.faces[-1] = replace(b.faces[-1], texture=np.full_like(b.faces[-1].texture, value))
        profile += [(x_m, z_m), (end_m, z_m)]
        x_m = end_m
    depth_m = stairs * drop_m
    b.ceiling(low, high)
    b.room(low, high, doors=2, pictures=3)
    for a, c in (((at_m, half_m), (LENGTH_M, half_m)), ((LENGTH_M, -half_m), (at_m, -half_m))):
        b.upright(a, c, (-depth_m, 0.0), b.wall_grey)
    b.upright((LENGTH_M, half_m), (LENGTH_M, -half_m), (-depth_m, 0.0), b.wall_grey)
    edge = np.array([[[at_m, -half_m], [at_m, half_m]]])
    return Trial(built(b, ground=Ground(tuple(profile)), edges=edge), objects=())


def _steep_ramp(b: Builder) -> Trial:
    """A ramp down of 20 degrees: it may be driven, or not."""
    at_m, low, high = b.rng.uniform(2.0, 3.0), (-BEHIND_M, -1.2), (LENGTH_M, 1.2)
    down_m = 2.0 * math.tan(math.radians(20.0))
    b.floor(low, (at_m, 1.2))
    b.floor((at_m, -1.2), (at_m + 2.0, 1.2), (0.0, -down_m))
    b.floor((at_m + 2.0, -1.2), high, (-down_m, -down_m))
    b.ceiling(low, high)
    b.room(low, high, doors=2)
    for a, c in (((at_m, 1.2), (LENGTH_M, 1.2)), ((LENGTH_M, -1.2), (at_m, -1.2)), ((LENGTH_M, 1.2), (LENGTH_M, -1.2))):
        b.upright(a, c, (-down_m, 0.0), b.wall_grey)
    ground = Ground(((at_m, 0.0), (at_m + 2.0, -down_m)))
    return Trial(built(b, ground=ground), objects=(), way_m=at_m + 3.0)


def _white_wall(b: Builder) -> Trial:
    """A corridor that ends at a wall of fresh white paint, without a skirting board."""
    end_m, half_m = b.rng.uniform(3.5, 4.5), b.rng.uniform(1.0, 1.4)
    low, high = (-BEHIND_M, -half_m), (end_m, half_m)
    b.floor(low, high)
    b.ceiling(low, high)
    b.wall((low[0], half_m), (end_m, half_m), doors=1, pictures=1)
    b.wall((end_m, -half_m), (low[0], -half_m), doors=1)
    b.wall((low[0], -half_m), (low[0], half_m))
    first = len(b.faces)
    b.upright((end_m, half_m), (end_m, -half_m), (0.0, b.ceiling_m), 225.0)
    return _hazard(b, first)


def _glass_with_frame(b: Builder) -> Trial:
    """A glass door with a frame and a handle across the corridor; what is behind it is seen."""
    _wide_corridor(b)
    first, at_m = len(b.faces), b.rng.uniform(2.2, 3.0)
    frame = plain_paint(b.rng, float(b.rng.choice([60.0, 170.0, 220.0])))
    uprights: list[Part] = [(0.0, y, 0.0, 0.05, 0.05, 2.1) for y in (-1.5, -0.5, 0.5, 1.5)]
    across: list[Part] = [(0.0, 0.0, z, 0.04, 3.0, 0.06) for z in (0.0, 2.05)]
    b.object([*uprights, *across, (-0.05, 0.4, 0.9, 0.03, 0.03, 0.35)], (at_m, 0.0), 0.0, frame)
    for left_m in (1.5, 0.5, -0.5):
        origin, along = np.array([at_m, left_m, 2.05]), np.array([0.0, -1.0, 0.0])
        b.panes.append(Rectangle(origin, along, np.array([0.0, 0.0, -1.99]), np.full((8, 8), 255, np.uint8), "pane"))
    return replace(_hazard(b, first), objects=(*b.faces[first:], *b.panes))


def _star_legs(b: Builder) -> Trial:
    _wide_corridor(b)
    first = len(b.faces)
    b.star_chair((b.rng.uniform(2.5, 3.0), b.rng.uniform(-0.1, 0.1)), b.rng.uniform(0, math.tau))
    return _hazard(b, first)


# People


def _people(b: Builder, *people: Person) -> Trial:
    return Trial(built(b, people=people), objects=())


def _standing(b: Builder, height_m: float) -> Trial:
    """Somebody stands in the way, looking anywhere."""
    _wide_corridor(b)
    at, towards = _place(b), b.rng.uniform(-1, 1, 2)
    path = (at, (at[0] + towards[0], at[1] + towards[1]))
    return _people(b, Person(b.adult(height_m), Walker(path, 0.0)))


@dataclass(frozen=True, slots=True)
class RestingPerson(Person):
    """A person who rests at the points of a path that is walked once."""

    rests_s: tuple[float, ...]

    def place(self, walked_s: float) -> tuple[float, float, float]:
        """Return x, y [m] and heading [rad] after a time of walking and resting."""
        lengths_m = np.linalg.norm(np.diff(np.array(self.walk.path), axis=0), axis=1)
        reached_s = np.concatenate([[0.0], np.cumsum(lengths_m)]) / self.walk.speed_mps
        leaves_s = reached_s + np.cumsum(self.rests_s)
        times_s = np.column_stack([leaves_s - self.rests_s, leaves_s]).ravel()
        return Person.place(self, float(np.interp(walked_s, times_s, np.repeat(reached_s, 2))))


def _leads(b: Builder, *, comes_back: bool) -> Trial:
    """Somebody walks ahead of the robot and stops, or then steps back towards it."""
    _wide_corridor(b)
    y_m, stop_m = b.rng.uniform(-0.1, 0.1), b.rng.uniform(3.0, 4.5)
    path: tuple[Point, ...] = ((1.2, y_m), (stop_m, y_m))
    rests_s: tuple[float, ...] = (0.0, b.rng.uniform(0.5, 2.5))
    if comes_back:
        path, rests_s = (*path, (stop_m - 0.6, y_m)), (*rests_s, 0.0)
    faces, speed_mps = b.adult(), b.rng.uniform(0.5, 0.8)
    return _people(b, RestingPerson(faces, Walker(path, speed_mps, start_s=b.rng.uniform(2.0, 4.0)), rests_s))


def _steps_in(b: Builder, within_cm: str) -> Trial:
    """Somebody steps into the way when the robot is so near."""
    _wide_corridor(b)
    x_m, aside_m = b.rng.uniform(2.3, 3.0), float(b.rng.choice([-1, 1])) * 0.95
    starts_m = float(within_cm) / 100 + 0.2 + abs(aside_m) * 0.4
    path = ((x_m, aside_m), (x_m, b.rng.uniform(-0.1, 0.1)))
    return _people(b, Person(b.adult(), Walker(path, b.rng.uniform(0.8, 1.4), starts_within_m=starts_m)))


def _crossing(b: Builder, how: str, side: int = 0) -> Person:
    """Return who crosses the way, from a side, 0: either one; unless one of them stops, they meet."""
    x_m, speed_mps = b.rng.uniform(2.8, 3.5), b.rng.uniform(0.8, 1.6)
    aside_m = (side or float(b.rng.choice([-1, 1]))) * 1.8
    along_m = float(b.rng.choice([-1, 1])) * abs(aside_m) if how == "diagonally" else 0.0
    before_m = WALKER_MPS * (math.hypot(along_m, aside_m) / speed_mps + b.rng.uniform(0.0, 0.8))
    path: tuple[Point, ...] = ((x_m - along_m, aside_m), (x_m + along_m, -aside_m))
    start_s, starts_within_m = 0.0, math.hypot(before_m, aside_m)
    if how == "turns_round":
        path = (path[0], (x_m, b.rng.uniform(-0.1, 0.1)), path[0])
    if how in ("turns_round", "diagonally"):
        start_s, starts_within_m = 0.75 + (x_m - before_m) / WALKER_MPS, 0.0
    return Person(b.adult(), Walker(path, speed_mps, start_s=start_s, starts_within_m=starts_within_m))


def _crosses(b: Builder, how: str) -> Trial:
    half_m = b.rng.uniform(2.1, 2.6)
    b.space((-BEHIND_M, -half_m), (LENGTH_M, half_m), doors=3, pictures=3)
    people = [_crossing(b, how, side) for side in ((1, -1) if how == "two" else (0,))]
    if how == "from_a_door":
        (person,) = people
        (x_m, y_m), _ = person.walk.path
        wall_m, wide_m = math.copysign(b.rng.uniform(0.9, 1.2), y_m), 0.9
        ends = sorted(((-BEHIND_M, wall_m), (LENGTH_M, wall_m)), reverse=wall_m < 0)
        b.wall(ends[0], ends[1], [Opening(abs(x_m - ends[0][0]) - wide_m / 2, wide_m)])
    if how == "like_the_floor":
        floor = b.faces[0]
        grey = float(floor.texture.mean()) * floor.brightness
        people = [replace(one, faces=tuple(_in_grey(face, grey) for face in one.faces)) for one in people]
    return _people(b, *people)


# Nearer than the view


def _near(b: Builder, what: str, where: str) -> Trial:
    """Something stands 0.15 to 0.3 m from the outline of a robot that starts; it is driven towards it."""
    corridor(b, width_m=2.8)
    first, apart_m = len(b.faces), 0.2 + b.rng.uniform(0.15, 0.3)
    angle = {"ahead": 0.0, "behind": math.pi, "beside": math.pi / 2}[where] + b.rng.uniform(-0.15, 0.15)
    c, s = math.cos(angle), math.sin(angle)
    if what == "person":
        place = (apart_m + 0.2) * c, (apart_m + 0.2) * s, angle + math.pi
        b.faces += [moved(face, place) for face in b.adult()]
    else:
        side_m = b.rng.uniform(0.3, 0.5) if what == "box" else b.rng.uniform(0.06, 0.1)
        paint = kind_paint(b.rng, {"white_pole": "white", "textured_pole": "granite", "box": "plaster"}[what])
        at = ((apart_m + side_m / 2) * c, (apart_m + side_m / 2) * s, 0.0)
        b.faces += solid(at, (side_m, side_m, 0.6 if what == "box" else 1.8), angle, paint, is_raised=False)
    motion = {"ahead": "ahead", "behind": "back", "beside": "turn left"}[where]
    return replace(_hazard(b, first), motion=motion)  # type: ignore[arg-type]


def _robot(b: Builder, **changes: object) -> Trial:
    """A corridor in which the robot is another one, or something happens to it."""
    corridor(b, width_m=2.2)
    return Trial(built(b), changes=tuple(changes.items()))


LEFT, RIGHT = SimulatedRobot.wheel_errors
CROSSING: Final = ("straight", "diagonally", "like_the_floor", "two", "from_a_door", "turns_round")
NEAR: Final = ("white_pole", "textured_pole", "box", "person")
ALL_OBJECTS: Final = (*OBJECTS, "trolley")
# Worlds in which nothing is in the way, but for those of harmless_worlds.
OF_ROBOT: Final[Makers] = {
    "lean_1deg": (None, partial(_robot, lean_rad=(0.0, math.radians(1.0)))),
    "pushed": (None, partial(_robot, pushes=(Push(5.0, 5.5, 0.3, 0.15), Push(11.0, 11.5, -0.3, -0.15)))),
    "slip_20": (None, partial(_robot, slips=(Slip(5.0, 7.0, 0.2), Slip(12.0, 14.0, 0.2)))),
    "slip_40": (None, partial(_robot, slips=(Slip(8.0, 10.0, 0.4),))),
    "weak_motor": (None, partial(_robot, wheel_errors=(LEFT - 0.08, RIGHT))),
}
MAKERS: Final[Makers] = {
    **harmless_worlds.MAKERS,
    **OF_ROBOT,
    rf"(plain_|)({'|'.join(ALL_OBJECTS)})": (None, _object),
    r"(pole|box|leg|edge)_(\d+)percent": ("linoleum", _contrast),
    r"edge_(\d+)cm": (None, _edge),
    "stairs_down": (None, partial(_edge, drop_cm="17", stairs=5)),
    "steep_ramp": (None, _steep_ramp),
    "white_wall": (None, _white_wall),
    "glass_with_frame": (None, _glass_with_frame),
    "star_legs": (None, _star_legs),
    "person_stands": (None, partial(_standing, height_m=1.75)),
    "child_stands": (None, partial(_standing, height_m=1.0)),
    "person_stops": (None, partial(_leads, comes_back=False)),
    "person_steps_back": (None, partial(_leads, comes_back=True)),
    r"person_steps_in_at_(\d+)cm": (None, _steps_in),
    rf"person_crosses_({'|'.join(CROSSING)})": (None, _crosses),
    rf"near_({'|'.join(NEAR)})_(ahead|behind|beside)": (None, _near),
}
HARMLESS: Final = (*harmless_worlds.NAMES, *OF_ROBOT)
HAZARDS: Final = (
    *ALL_OBJECTS,
    *(f"plain_{name}" for name in ALL_OBJECTS),
    *(f"{name}_{percent}percent" for name in ("pole", "box", "leg", "edge") for percent in (10, 20)),
    *(f"edge_{drop}cm" for drop in (8, 15, 30, 50)),
    *("stairs_down", "steep_ramp", "white_wall", "glass_with_frame", "star_legs", "person_stands", "child_stands"),
    *("person_stops", "person_steps_back", "person_steps_in_at_80cm", "person_steps_in_at_150cm"),
    *(f"person_crosses_{how}" for how in CROSSING),
    *(f"near_{what}_{where}" for what in NEAR for where in ("ahead", "behind", "beside")),
)
