"""World files: TOML, described in omnid/simulation/WORLDS.md; textures follow from a seed.

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
from collections.abc import Collection
from dataclasses import dataclass, replace
from importlib.resources import files
from itertools import pairwise
from pathlib import Path
from typing import Final

import numpy as np

from calib.errors import CalibError
from calib.models.camera import Array
from calib.validation import ValidatedTable, decode, read_bytes, require_schema, toml_table
from omnid.errors import OmnidError
from omnid.simulation.people import Person
from omnid.simulation.rendering import textures
from omnid.simulation.rendering.shapes import CEILING_M, Point, Random, box, painted, posters
from omnid.simulation.rendering.surfaces import Rectangle
from omnid.simulation.world import World

SCHEMA: Final = 1
MAX_BYTES: Final = 1 << 18
MOST_WALLS, MOST_BOXES, MOST_PEOPLE, MOST_POINTS, MOST_DOORS = 200, 200, 20, 100, 8
LARGEST_M: Final = 60.0  # side of a world: its textures must fit into memory
LARGEST_AREA_M2: Final = 1200.0  # of all painted surfaces, without posters
PX_PER_M, FLOOR_PX_PER_M = 200.0, 120.0  # Textures of walls, and of floor and ceiling.
ROUNDING_M: Final = 1e-6
PERSON_M: Final = (0.25, 0.45, 1.7)  # depth, width, height
RANDOM: Final = "random"
KINDS: Final = ("brick", "plaster", "granite", "plaster")  # Textures of a random wall.
TEXTURES: Final = (*textures.PAINTERS, RANDOM)
BOX_TEXTURES: Final = ("poster", *textures.PAINTERS)


@dataclass(frozen=True, slots=True)
class WorldOptions:
    """Changes of a world between two drives."""

    people: bool = True
    brightness: float = 1.0
    other_posters: float = 0.0  # share of the posters that is exchanged
    posters_seed: int = 0  # of the exchanged ones

    def __post_init__(self) -> None:
        if not (0.05 <= self.brightness <= 3.0 and 0.0 <= self.other_posters <= 1.0 and self.posters_seed >= 0):
            raise OmnidError(
                f"world: brightness {self.brightness:g}, other posters {self.other_posters:g}, seed "
                f"{self.posters_seed}: give 0.05 to 3, 0 to 1, and 0 or more"
            )


def shipped_worlds() -> list[str]:
    """Return the names of the worlds that come with the program."""
    return sorted(entry.name[:-5] for entry in files("omnid.simulation.worlds").iterdir() if entry.name[-5:] == ".toml")


def load_world(name: str, seed: int = 0, options: WorldOptions | None = None) -> World:
    """Return a shipped world or that of a file (a name that ends in .toml); raise OmnidError for wrong ones."""
    try:
        if name in shipped_worlds():
            text = (files("omnid.simulation.worlds") / f"{name}.toml").read_text("utf-8")
        elif name.endswith(".toml"):
            text = decode(read_bytes(Path(name), MAX_BYTES), name)
        else:
            raise OmnidError(
                f"world {name!r} is not known; name a file *.toml, or one of {', '.join(shipped_worlds())}"
            )
        return parse_world(text, name, seed, options or WorldOptions())
    except CalibError as error:
        raise OmnidError(str(error)) from None


def parse_world(text: str, name: str, seed: int, options: WorldOptions) -> World:
    """Return the world of a text; same text, seed and options, same world. Raises CalibError for a wrong text."""
    top = toml_table(text, name)
    top.allow_only(("schema", "start", "light", "space", "wall", "box", "person"))
    require_schema(top, SCHEMA)
    rng = np.random.default_rng([seed, 41])
    space = _Space.of(top.table("space"))
    walls, boxes, persons = (
        top.tables(key, most) for key, most in (("wall", MOST_WALLS), ("box", MOST_BOXES), ("person", MOST_PEOPLE))
    )
    x_m, y_m, heading_deg = top.numbers("start", 3)
    # 1. Refuse what cannot be, before textures are painted, which takes time and memory.
    if not space.contains((x_m, y_m)):
        top.fail("start", "a place within the space")
    for table in boxes:
        _check_box(table, space, (x_m, y_m))
    area_m2 = (
        space.area_m2
        + sum(_wall_area_m2(table, space.ceiling_m) for table in walls)
        + sum(_box_area_m2(_size(table)) for table in boxes)
        + sum(_box_area_m2(_person_size(table)) for table in persons)
    )
    if area_m2 > LARGEST_AREA_M2:
        raise CalibError(f"{name}: the surfaces are {area_m2:.0f} m2; expected at most {LARGEST_AREA_M2:g}")
    # 2. Paint the surfaces, always in the same order, because each takes its random numbers from the same generator.
    surfaces = space.floor_and_ceiling(rng)
    for table in walls:
        surfaces += _wall(rng, table, space.ceiling_m)
    for table in boxes:
        surfaces += _box(rng, table)
    people = tuple(_person(rng, table) for table in persons)
    if options.other_posters:
        surfaces = _exchanged(surfaces, options)
    brightness = options.brightness * _within(top, "light", 0.05, 3.0, 1.0)
    start = x_m, y_m, math.radians(heading_deg)
    return World(name, tuple(surfaces), people if options.people else (), start, brightness, space.is_polished)


@dataclass(frozen=True, slots=True)
class _Space:
    """Floor and ceiling."""

    low: Point
    high: Point
    ceiling_m: float
    kinds: tuple[str, str]
    is_polished: bool

    @staticmethod
    def of(table: ValidatedTable) -> _Space:
        table.allow_only(("low", "high", "ceiling_m", "floor", "ceiling", "finish"))
        (x0, y0), (x1, y1) = table.numbers("low", 2), table.numbers("high", 2)
        if not (0.5 <= x1 - x0 <= LARGEST_M and 0.5 <= y1 - y0 <= LARGEST_M):
            table.fail("high", f"a corner 0.5 to {LARGEST_M:g} m beyond low")
        ceiling_m = _within(table, "ceiling_m", 1.5, 20.0, CEILING_M)
        kinds = (
            _choice(table, "floor", textures.PAINTERS, "tiles"),
            _choice(table, "ceiling", textures.PAINTERS, "tiles"),
        )
        is_polished = _choice(table, "finish", ("matt", "polished"), "matt") == "polished"
        return _Space((x0, y0), (x1, y1), ceiling_m, kinds, is_polished)

    @property
    def area_m2(self) -> float:
        (x0, y0), (x1, y1) = self.low, self.high
        return 2 * (x1 - x0) * (y1 - y0)

    def contains(self, point: Point) -> bool:
        return all(
            low - ROUNDING_M <= value <= high + ROUNDING_M
            for low, value, high in zip(self.low, point, self.high, strict=True)
        )

    def floor_and_ceiling(self, rng: Random) -> list[Rectangle]:
        (x0, y0), (x1, y1) = self.low, self.high
        along, across = np.array([x1 - x0, 0.0, 0.0]), np.array([0.0, y1 - y0, 0.0])
        floor, ceiling = (painted(rng, kind, (x1 - x0, y1 - y0), FLOOR_PX_PER_M) for kind in self.kinds)
        return [
            Rectangle(np.array([x0, y1, 0.0]), along, -across, floor, "floor"),
            Rectangle(np.array([x0, y0, self.ceiling_m]), along, across, ceiling, "ceiling"),
        ]


def _check_box(table: ValidatedTable, space: _Space, start: Point) -> None:
    """Check that a box lies within the space, and that the robot does not start in it."""
    x_m, y_m, yaw_rad = _box_pose(table)
    c, s = math.cos(yaw_rad), math.sin(yaw_rad)
    along_m, across_m = (side / 2 for side in _size(table)[:2])
    corners = [
        (x_m + c * i * along_m - s * j * across_m, y_m + s * i * along_m + c * j * across_m)
        for i in (-1, 1)
        for j in (-1, 1)
    ]
    if not all(map(space.contains, corners)):
        table.fail("at", "a place where the whole box is within the space")
    dx_m, dy_m = start[0] - x_m, start[1] - y_m
    if abs(c * dx_m + s * dy_m) <= along_m and abs(c * dy_m - s * dx_m) <= across_m:
        table.fail("at", "a place where the robot does not start inside the box")


def _box_pose(table: ValidatedTable) -> tuple[float, float, float]:
    x_m, y_m = table.numbers("at", 2)
    return x_m, y_m, math.radians(table.number("yaw_deg")) if table.has("yaw_deg") else 0.0


def _box_area_m2(size_m: tuple[float, float, float]) -> float:
    x_m, y_m, z_m = size_m
    return 2 * (x_m + y_m) * z_m + x_m * y_m


def _wall_area_m2(table: ValidatedTable, ceiling_m: float) -> float:
    """Return the area of a wall, of which doors are a part."""
    return _wall_height_m(table, ceiling_m) * sum(
        math.dist(a, b) for a, b in pairwise(table.points("points", 2, MOST_POINTS))
    )


def _wall_height_m(table: ValidatedTable, ceiling_m: float) -> float:
    return _within(table, "height_m", 0.05, 20.0, ceiling_m)


def _wall(rng: Random, table: ValidatedTable, ceiling_m: float) -> list[Rectangle]:
    """Return the parts of a wall along a polyline, with its posters; doors are in the first part of the polyline."""
    table.allow_only(("points", "texture", "height_m", "posters_per_m", "poster_sides", "doors"))
    points = table.points("points", 2, MOST_POINTS)
    height_m = _wall_height_m(table, ceiling_m)
    kind = _choice(table, "texture", TEXTURES, RANDOM)
    per_m = _within(table, "posters_per_m", 0.0, 4.0, 0.0)
    both = _choice(table, "poster_sides", ("front", "both"), "front") == "both"
    doors = [_door(door) for door in table.tables("doors", MOST_DOORS)]
    parts: list[Rectangle] = []
    for number, (a, b) in enumerate(pairwise(points)):
        chosen = str(rng.choice(KINDS)) if kind == RANDOM else kind
        parts += _pieces(rng, chosen, a, b, height_m, doors if number == 0 else [])
    hung: list[Rectangle] = []
    for part in parts:
        if height_m >= CEILING_M - 0.2 and part.height_m > 0.8 * height_m and part.width_m > 0.6:
            for side in (part, _other_side(part))[: 1 + both]:
                hung += posters(rng, side, round(per_m * part.width_m), len(hung))
    return parts + hung


def _door(table: ValidatedTable) -> tuple[float, float, float]:
    """Return the distance from the wall's beginning, width and height [m] of a door."""
    table.allow_only(("at_m", "width_m", "height_m"))
    return (
        _within(table, "at_m", 0.0, LARGEST_M),
        _within(table, "width_m", 0.3, 10.0),
        _within(table, "height_m", 0.3, 20.0, 2.1),
    )


def _pieces(
    rng: Random, kind: str, left: Point, right: Point, height_m: float, doors: list[tuple[float, float, float]]
) -> list[Rectangle]:
    """Return a straight wall between two points, left and right as seen from its front, without its doors."""
    a, b = np.array([*left, 0.0]), np.array([*right, 0.0])
    length_m = float(np.linalg.norm(b - a))
    along = (b - a) / max(length_m, 1e-9)
    pieces, begin_m = [], 0.0
    for at_m, width_m, door_m in sorted(doors):
        pieces.append((begin_m, at_m, 0.0))
        pieces.append((at_m, at_m + width_m, door_m))
        begin_m = at_m + width_m
    pieces.append((begin_m, length_m, 0.0))
    return [
        _upright(rng, kind, a + begin_m * along, a + min(end_m, length_m) * along, low_m, height_m)
        for begin_m, end_m, low_m in pieces
        if min(end_m, length_m) - begin_m > 0.01 and height_m - low_m > 0.01
    ]


def _upright(rng: Random, kind: str, a: Array, b: Array, low_m: float, high_m: float) -> Rectangle:
    """Return the upright rectangle between two points (3,) of the floor, left and right as seen from its front."""
    size = (float(np.linalg.norm(b - a)), high_m - low_m)
    up, texture = np.array([0.0, 0.0, 1.0]), painted(rng, kind, size, PX_PER_M)
    return Rectangle(a + high_m * up, b - a, (low_m - high_m) * up, texture, kind)


def _other_side(side: Rectangle) -> Rectangle:
    """Return the same wall as seen from behind."""
    return Rectangle(side.origin + side.edge_u, -side.edge_u, side.edge_v, side.texture, side.name)


def _box(rng: Random, table: ValidatedTable) -> list[Rectangle]:
    table.allow_only(("at", "size_m", "yaw_deg", "texture"))
    x_m, y_m, yaw_rad = _box_pose(table)
    faces = box(rng, (x_m, y_m), _size(table), yaw_rad)
    kind = _choice(table, "texture", BOX_TEXTURES, "poster")
    if kind == "poster":
        return faces
    return [replace(face, texture=painted(rng, kind, (face.width_m, face.height_m))) for face in faces]


def _person(rng: Random, table: ValidatedTable) -> Person:
    table.allow_only(("path", "speed_mps", "repeat", "start_s", "starts_within_m", "waits_within_m", "size_m"))
    return Person(
        tuple(box(rng, (0.0, 0.0), _person_size(table), 0.0)),
        tuple(table.points("path", 2, MOST_POINTS)),
        _within(table, "speed_mps", 0.0, 5.0, 1.0),
        _choice(table, "repeat", ("once", "loop", "back and forth"), "once"),
        _within(table, "start_s", 0.0, 1e5, 0.0),
        _within(table, "starts_within_m", 0.0, 100.0, 0.0),
        _within(table, "waits_within_m", 0.0, 100.0, 0.0),
    )


def _person_size(table: ValidatedTable) -> tuple[float, float, float]:
    return _size(table) if table.has("size_m") else PERSON_M


def _size(table: ValidatedTable) -> tuple[float, float, float]:
    x_m, y_m, z_m = table.numbers("size_m", 3)
    if not all(0.02 <= side <= 20.0 for side in (x_m, y_m, z_m)):
        table.fail("size_m", "three sides of 0.02 to 20 m")
    return x_m, y_m, z_m


def _within(table: ValidatedTable, key: str, low: float, high: float, default: float | None = None) -> float:
    """Return the number under a key, from low to high; default: None where the key is required."""
    if default is not None and not table.has(key):
        return default
    value = table.number(key)
    if not low <= value <= high:
        table.fail(key, f"a number from {low:g} to {high:g}")
    return value


def _choice(table: ValidatedTable, key: str, options: Collection[str], default: str) -> str:
    return table.choice(key, options) if table.has(key) else default


def _exchanged(surfaces: list[Rectangle], options: WorldOptions) -> list[Rectangle]:
    """Return the rectangles with a share of the posters exchanged."""
    rng = np.random.default_rng([options.posters_seed, 42])
    return [
        replace(r, texture=textures.poster(rng, (r.texture.shape[1], r.texture.shape[0])))
        if r.name.startswith("poster") and rng.random() < options.other_posters
        else r
        for r in surfaces
    ]
