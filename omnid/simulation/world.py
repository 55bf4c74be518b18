"""A simulated world: walls and objects, people who walk along polylines, light, and the obstacles of a robot.

World files are TOML, described in docs/drive.md; textures follow from a seed.

schema = 1
start = [0.0, 0.0, 0.0]
[space]
low = [-3.0, -2.5]
high = [3.0, 2.5]
[[wall]]
points = [[-3.0, -2.5], [-3.0, 2.5], [3.0, 2.5], [3.0, -2.5], [-3.0, -2.5]]
texture = "brick"
posters_per_m = 0.5
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from importlib.resources import files
from itertools import pairwise
from typing import Annotated, Final, Literal, TypeAlias

import numpy as np
from msgspec import Meta, Struct

from calib import se3
from calib.models.camera import Array
from calib.se2_arrays import from_segments_m
from calib.typed_toml import bytes_of, convert, table_of
from calib.validation import MAX_FILE_BYTES
from drivers.motors.simulated_motor import Pose
from omnid.errors import OmnidError
from omnid.simulation.rendering import surfaces
from omnid.simulation.rendering.surfaces import CEILING_M, Point, Random, Rectangle


@dataclass(frozen=True, slots=True)
class Person:
    """A box of a person's size that walks along a path and faces ahead."""

    faces: tuple[Rectangle, ...]  # in a frame on the floor below the middle, x ahead
    walk: Walker

    def place(self, walked_s: float) -> tuple[float, float, float]:
        """Return x, y [m] and heading [rad] after a time of walking."""
        points = np.array(self.walk.path)
        reached_m = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(points, axis=0), axis=1))])
        along_m, back, total_m = self.walk.speed_mps * max(walked_s, 0.0), False, float(reached_m[-1])
        if self.walk.repeat != "once" and total_m > 0.0:
            laps, along_m = divmod(along_m, total_m)
            back = self.walk.repeat == "back and forth" and laps % 2 == 1
        along_m = min(along_m, total_m)
        along_m = total_m - along_m if back else along_m
        part = min(int(np.searchsorted(reached_m[1:], along_m)), len(points) - 2)
        ahead = (points[part + 1] - points[part]) * (-1 if back else 1)
        x_m, y_m = (float(np.interp(along_m, reached_m, points[:, axis])) for axis in (0, 1))
        return x_m, y_m, math.atan2(ahead[1], ahead[0])


class Walkers:
    """The people of a world as time passes; those who wait for the robot begin when it is near enough."""

    def __init__(self, people: tuple[Person, ...]) -> None:
        self._people = people
        self._started_s: list[float | None] = [
            None if person.walk.starts_within_m else person.walk.start_s for person in people
        ]
        self.time_s = 0.0

    def advance(self, time_s: float, robot: Point) -> None:
        """Set the time, with the robot at a point [m]."""
        self.time_s = time_s
        for number, walk in enumerate(person.walk for person in self._people):
            is_near = math.dist(robot, walk.path[-1]) <= walk.starts_within_m
            if self._started_s[number] is None and time_s >= walk.start_s and is_near:
                self._started_s[number] = time_s

    def faces(self) -> list[Rectangle]:
        """Return the people's rectangles in the world now."""
        return [
            moved(face, place)
            for person, place in zip(self._people, self.places(), strict=True)
            for face in person.faces
        ]

    def places(self) -> list[tuple[float, float, float]]:
        """Return x, y [m] and heading [rad] of each person now."""
        return [
            person.place(0.0 if started_s is None else self.time_s - started_s)
            for person, started_s in zip(self._people, self._started_s, strict=True)
        ]


def moved(face: Rectangle, place: tuple[float, float, float]) -> Rectangle:
    """Return a rectangle of a frame on the floor in the world; its texture is shared."""
    x_m, y_m, heading_rad = place
    c, s = math.cos(heading_rad), math.sin(heading_rad)
    R: Array = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
    return replace(face, origin=R @ face.origin + (x_m, y_m, 0.0), edge_u=R @ face.edge_u, edge_v=R @ face.edge_v)


CLIMBED_M = 0.035  # Objects that are lower than this are driven over: steps of 2 and 3 cm, cables, plates.
FLAT_M = 0.01  # Rectangles that rise by less are horizontal.


@dataclass(frozen=True)
class World:
    """A level floor at z = 0 and what is on it; the robot starts at x, y [m], heading [rad].

    Subclasses override its methods for ground that is not level and light that changes.
    """

    name: str
    standing: tuple[Rectangle, ...]
    people: tuple[Person, ...] = ()
    start: Pose = (0.0, 0.0, 0.0)
    brightness: float = 1.0  # factor on the grey of all images

    def T_world_base(self, pose: Pose) -> Array:
        """Return the pose (4, 4) of a base there; x, y and heading are those of its middle."""
        x_m, y_m, heading_rad = pose
        return se3.transform(se3.rotation_exp([0.0, 0.0, heading_rad]), [x_m, y_m, 0.0])

    def turned_rad(self, before: Pose, now: Pose) -> Array:
        """Return the rotation vector (3,) of a base between two poses, in its own frame."""
        return np.array([0.0, 0.0, math.remainder(now[2] - before[2], math.tau)])

    def light_at(self, time_s: float) -> float:
        """Return the factor on the grey of all images."""
        return self.brightness

    def footprints(self, rectangles: Sequence[Rectangle], height_m: float) -> Array:
        """Return the segments (N, 2, 2) [m] on the floor of all that reaches below a height, other than the floor.

        Rectangles named "floor" are never met, nor is what is driven over. Boxes and walls are closed by upright
        rectangles, so that their outlines are enough.
        """
        segments = []
        for rectangle in rectangles:
            corners = rectangle.corners
            low_m, high_m = corners[:, 2].min(), corners[:, 2].max()
            if rectangle.name != "floor" and high_m - low_m > FLAT_M and low_m < height_m and high_m > CLIMBED_M:
                spread = corners[:, :2] - corners[0, :2]
                far = int(np.argmax((spread**2).sum(axis=1)))
                other = int(np.argmax(((corners[:, :2] - corners[far, :2]) ** 2).sum(axis=1)))
                segments.append(corners[[far, other], :2])
        return np.array(segments).reshape(-1, 2, 2)

    def obstacles(self, height_m: float) -> Array:
        """Return the segments (N, 2, 2) [m] of all that a robot of a height may touch."""
        return self.footprints(self.standing, height_m)


def distances_m(segments: Array, places: Array) -> Array:
    """Return the distances (M,) [m] of places (M, 2) from the nearest of segments (N, 2, 2); inf without any."""
    return np.asarray(from_segments_m(places, segments[:, 0], segments[:, 1]).min(axis=1, initial=np.inf))


def clearance_m(segments: Array, place: tuple[float, float], radius_m: float) -> float:
    """Return the distance [m] from a disc, the robot's outline, to the nearest of segments; 0 or less: contact."""
    return float(distances_m(segments, np.array([place]))[0]) - radius_m


# World files.

PX_PER_M, FLOOR_PX_PER_M = 200.0, 120.0  # Textures of walls, and of floor and ceiling.
KINDS: Final = ("brick", "plaster", "granite", "plaster")  # Textures of a random wall.
Side: TypeAlias = Annotated[float, Meta(ge=0.02, le=20.0)]  # m
Distance: TypeAlias = Annotated[float, Meta(ge=0.0, le=100.0)]  # m
Size: TypeAlias = tuple[Side, Side, Side]
Path: TypeAlias = Annotated[tuple[Point, ...], Meta(min_length=2)]
# Of surfaces.PAINTERS.
Texture: TypeAlias = Literal[
    "brick", "plaster", "granite", "tiles", "plain", "white", "linoleum", "epoxy", "marbled", "carpet"
]


class Door(Struct, frozen=True, order=True):
    """An opening in a wall, by its distance from the wall's beginning."""

    at_m: Distance
    width_m: Side
    height_m: Side = 2.1


class Wall(Struct, frozen=True):
    """A wall along a polyline; doors are in the first part of it."""

    points: Path
    texture: Literal[Texture, "random"] = "random"
    height_m: Side | None = None  # None: up to the ceiling
    posters_per_m: Annotated[float, Meta(ge=0.0, le=4.0)] = 0.0
    poster_sides: Literal["front", "both"] = "front"
    doors: tuple[Door, ...] = ()


class Box(Struct, frozen=True):
    """A box on the floor, or over it."""

    at: Point
    size_m: Size
    bottom_m: Distance = 0.0  # over the floor
    yaw_deg: float = 0.0
    texture: Literal[Texture, "poster"] = "poster"


class Walker(Struct, frozen=True):
    """A box that walks along a polyline."""

    path: Path
    speed_mps: Annotated[float, Meta(ge=0.0, le=5.0)] = 1.0
    repeat: Literal["once", "loop", "back and forth"] = "once"
    start_s: Annotated[float, Meta(ge=0.0)] = 0.0
    starts_within_m: Distance = 0.0  # waits until the robot is this near to its last point; 0: does not wait
    size_m: Size = (0.25, 0.45, 1.7)  # depth, width, height


class Space(Struct, frozen=True):
    """Floor and ceiling."""

    low: Point
    high: Point
    ceiling_m: Annotated[float, Meta(ge=1.5, le=20.0)] = CEILING_M
    floor: Texture = "tiles"
    ceiling: Texture = "tiles"

    @property
    def sides_m(self) -> Point:
        """Sizes along x and y."""
        return self.high[0] - self.low[0], self.high[1] - self.low[1]

    def floor_and_ceiling(self, rng: Random) -> list[Rectangle]:
        """Return the painted floor and ceiling."""
        (x0, y0), (_, y1), (width, depth) = self.low, self.high, self.sides_m
        along, across = np.array([width, 0.0, 0.0]), np.array([0.0, depth, 0.0])
        kinds = self.floor, self.ceiling
        floor, ceiling = (surfaces.painted(rng, kind, self.sides_m, FLOOR_PX_PER_M) for kind in kinds)
        return [
            Rectangle(np.array([x0, y1, 0.0]), along, -across, floor, "floor"),
            Rectangle(np.array([x0, y0, self.ceiling_m]), along, across, ceiling, "ceiling"),
        ]


class WorldTable(Struct, frozen=True):
    """The whole file."""

    schema: Literal[1]  # it rises when an earlier program would misread the file
    start: tuple[float, float, float]
    space: Space
    light: Annotated[float, Meta(ge=0.05, le=3.0)] = 1.0
    wall: tuple[Wall, ...] = ()
    box: tuple[Box, ...] = ()
    person: tuple[Walker, ...] = ()


def shipped_worlds() -> list[str]:
    """Return the names of the worlds that come with the program."""
    return sorted(entry.name[:-5] for entry in files("omnid.simulation.worlds").iterdir() if entry.name[-5:] == ".toml")


def load_world(name: str, seed: int = 0) -> World:
    """Return a shipped world or that of a file (a name that ends in .toml); raise OmnidError for wrong ones."""
    try:
        if name in shipped_worlds():
            data = (files("omnid.simulation.worlds") / f"{name}.toml").read_bytes()
        elif name.endswith(".toml"):
            data = bytes_of(name, MAX_FILE_BYTES)
        else:
            raise OmnidError(
                f"world {name!r} is not known; name a file *.toml, or one of {', '.join(shipped_worlds())}"
            )
        return _painted_world(convert(WorldTable, table_of(data)), name, seed)
    except ValueError as error:
        raise OmnidError(f"{name}: {error}") from None


def _painted_world(world: WorldTable, name: str, seed: int) -> World:
    """Return the world of a table; same table and seed, same world. Raise ValueError for an impossible one."""
    space, (x_m, y_m, heading_deg) = world.space, world.start
    rng = np.random.default_rng([seed, 41])
    # 1. Refuse what cannot be.
    if min(space.sides_m) < 0.5:
        raise ValueError(f"space.high: expected a corner 0.5 m or more beyond low, found {space.high}")
    if not all(low <= at <= high for low, at, high in zip(space.low, world.start[:2], space.high, strict=True)):
        raise ValueError(f"start: expected a place within the space, found {world.start[:2]}")
    # 2. Paint the surfaces, always in the same order, because each takes its random numbers from the same generator.
    surfaces = space.floor_and_ceiling(rng)
    for wall in world.wall:
        surfaces += _wall(rng, wall, wall.height_m or space.ceiling_m)
    for entry in world.box:
        surfaces += _box(rng, entry)
    people = tuple(Person(tuple(_box(rng, Box((0.0, 0.0), walker.size_m))), walker) for walker in world.person)
    return World(name, tuple(surfaces), people, (x_m, y_m, math.radians(heading_deg)), world.light)


def _wall(rng: Random, wall: Wall, height_m: float) -> list[Rectangle]:
    """Return the parts of a wall along its polyline, with its posters."""
    parts: list[Rectangle] = []
    for number, (a, b) in enumerate(pairwise(wall.points)):
        chosen = str(rng.choice(KINDS)) if wall.texture == "random" else wall.texture
        parts += _pieces(rng, chosen, a, b, height_m, wall.doors if number == 0 else ())
    hung: list[Rectangle] = []
    for part in parts:
        if height_m >= CEILING_M - 0.2 and part.height_m > 0.8 * height_m and part.width_m > 0.6:
            behind = replace(part, origin=part.origin + part.edge_u, edge_u=-part.edge_u)
            for side in (part, behind)[: 2 if wall.poster_sides == "both" else 1]:
                hung += surfaces.posters(rng, side, round(wall.posters_per_m * part.width_m), len(hung))
    return parts + hung


def _pieces(
    rng: Random, kind: str, left: Point, right: Point, height_m: float, doors: tuple[Door, ...]
) -> list[Rectangle]:
    """Return a straight wall between two points, left and right as seen from its front, without its doors."""
    a, b = np.array([*left, 0.0]), np.array([*right, 0.0])
    length_m = float(np.linalg.norm(b - a))
    along = (b - a) / max(length_m, 1e-9)
    pieces, begin_m = [], 0.0
    for door in sorted(doors):
        end_m = door.at_m + door.width_m
        pieces.append((begin_m, door.at_m, 0.0))
        pieces.append((door.at_m, end_m, door.height_m))
        begin_m = end_m
    pieces.append((begin_m, length_m, 0.0))
    walls, up = [], np.array([0.0, 0.0, 1.0])
    for begin_m, end_m, low_m in pieces:
        end_m = min(end_m, length_m)
        if end_m - begin_m > 0.01 and height_m - low_m > 0.01:
            texture = surfaces.painted(rng, kind, (end_m - begin_m, height_m - low_m), PX_PER_M)
            corner, down = a + begin_m * along + height_m * up, (low_m - height_m) * up
            walls.append(Rectangle(corner, (end_m - begin_m) * along, down, texture, kind))
    return walls


def _box(rng: Random, entry: Box) -> list[Rectangle]:
    paint = partial(surfaces.painted, rng, entry.texture)
    at, yaw_rad = (*entry.at, entry.bottom_m), math.radians(entry.yaw_deg)
    chosen = surfaces.poster_paint(rng) if entry.texture == "poster" else paint
    return surfaces.solid(at, entry.size_m, yaw_rad, chosen, is_raised=entry.bottom_m > 0)
