"""World files: TOML, described in docs/drive.md; textures follow from a seed.

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
from dataclasses import replace
from functools import partial
from importlib.resources import files
from itertools import pairwise
from typing import Annotated, Final, Literal, TypeAlias

import numpy as np
from msgspec import Meta, Struct
from msgspec.structs import asdict

from calib.typed_toml import bytes_of, convert, table_of
from omnid.errors import OmnidError
from omnid.simulation.rendering import surfaces
from omnid.simulation.rendering.surfaces import CEILING_M, Point, Random, Rectangle
from omnid.simulation.world import Person, World

MAX_BYTES: Final = 1 << 18  # which also bounds the numbers of things
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
    starts_within_m: Distance = 0.0
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
            data = bytes_of(name, MAX_BYTES)
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
    people = tuple(_person(rng, walker) for walker in world.person)
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


def _person(rng: Random, walker: Walker) -> Person:
    walk = asdict(walker)
    return Person(tuple(surfaces.box(rng, (0.0, 0.0), walk.pop("size_m"), 0.0)), **walk)
