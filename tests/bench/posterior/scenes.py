"""Small rooms with one kind of obstacle, with the exact range of the nearest obstacle or edge in every direction.

The floor is at z = 0. What a base must not reach: surfaces between LOWEST_M and HIGHEST_M over the floor, and edges at
which the floor falls by EDGE_M or more.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Final

import cv2
import numpy as np
from numpy.typing import NDArray

from calib import se3
from omnid.simulation.rendering.polished_floor import BLACK, WHITE, below_floor
from omnid.simulation.rendering.ray_caster import render_grey
from omnid.simulation.rendering.shapes import box, painted, posters
from omnid.simulation.rendering.surfaces import Rectangle, Scene
from omnid.simulation.robot import SimulatedRobot

Array = NDArray[np.float64]
Random = np.random.Generator

LOWEST_M: Final = 0.06
HIGHEST_M: Final = 1.25
EDGE_M: Final = 0.05
FLOOR_PX_PER_M: Final = 250.0
CEILING_M: Final = 2.6
FLOORS: Final = ("tiles", "granite", "plaster")
WALLS: Final = ("brick", "granite", "plaster")


@dataclass(frozen=True, slots=True)
class ObstacleScene:
    """A room, and what a base must not reach in it, seen from above."""

    name: str
    rectangles: tuple[Rectangle, ...]
    segments: Array  # (N, 2, 2) m: outlines and edges
    gloss: float = 0.0  # share of the light that the floor mirrors
    brightness: float = 1.0
    target: Array = field(default_factory=lambda: np.zeros((0, 2, 2)))  # (M, 2, 2) those of the thing itself

    def ranges_m(self, x_m: float, y_m: float, azimuths: Array) -> Array:
        """Return the nearest (N,) along directions (N,) from a place."""
        return nearest_m(self.segments, (x_m, y_m), azimuths)

    def is_target(self, x_m: float, y_m: float, azimuths: Array) -> NDArray[np.bool_]:
        """Return the directions (N,) in which the thing itself is the nearest."""
        if not len(self.target):
            return np.ones(len(azimuths), bool)
        return np.asarray(nearest_m(self.target, (x_m, y_m), azimuths) <= self.ranges_m(x_m, y_m, azimuths) + 1e-6)


def nearest_m(segments: Array, place: tuple[float, float], azimuths: Array) -> Array:
    """Return the range (N,) of the nearest of segments (M, 2, 2) along directions (N,), inf without one."""
    direction = np.column_stack([np.cos(azimuths), np.sin(azimuths)])
    start, along = segments[:, 0] - place, segments[:, 1] - segments[:, 0]
    across = direction[:, None, 0] * along[None, :, 1] - direction[:, None, 1] * along[None, :, 0]
    with np.errstate(divide="ignore", invalid="ignore"):
        distance = (start[:, 0] * along[:, 1] - start[:, 1] * along[:, 0]) / across
        share = (start[None, :, 0] * direction[:, None, 1] - start[None, :, 1] * direction[:, None, 0]) / across
    hit = np.where((distance > 0) & (share >= 0) & (share <= 1), distance, np.inf)
    return np.asarray(hit.min(axis=1, initial=np.inf))


def outlines(rectangles: list[Rectangle]) -> Array:
    """Return the outlines (N, 2, 2) seen from above of the rectangles that reach into the band of heights."""
    found = []
    for rectangle in rectangles:
        corners = rectangle.corners
        if corners[:, 2].max() >= LOWEST_M and corners[:, 2].min() <= HIGHEST_M:
            found += [corners[[i, (i + 1) % 4], :2] for i in range(4)]
    return np.array(found).reshape(-1, 2, 2)


def floor(rng: Random, kind: str, low: tuple[float, float], high: tuple[float, float], z_m: float = 0.0) -> Rectangle:
    """Return a level piece of floor."""
    size = high[0] - low[0], high[1] - low[1]
    return Rectangle(
        np.array([low[0], high[1], z_m]),
        np.array([size[0], 0.0, 0.0]),
        np.array([0.0, -size[1], 0.0]),
        painted(rng, kind, size, FLOOR_PX_PER_M),
        "floor",
    )


def _walls(rng: Random, low: tuple[float, float], high: tuple[float, float], kinds: list[str]) -> list[Rectangle]:
    corners = [(low[0], low[1]), (low[0], high[1]), (high[0], high[1]), (high[0], low[1])]
    made = []
    for k in range(4):
        (ax, ay), (bx, by) = corners[k], corners[(k + 1) % 4]
        a, b = np.array([ax, ay, CEILING_M]), np.array([bx, by, CEILING_M])
        size = float(np.linalg.norm(b - a)), CEILING_M + 1.0
        side = Rectangle(
            a, b - a, np.array([0.0, 0.0, -CEILING_M - 1.0]), painted(rng, kinds[k], size, 200.0), kinds[k]
        )
        made.append(side)
        if kinds[k] not in ("plain", "white"):
            made += posters(rng, side, round(0.5 * size[0]), 10 * k)
    return made


def cylinder(
    centre: tuple[float, float],
    diameter_m: float,
    heights_m: tuple[float, float],
    texture: NDArray[np.uint8],
    sides: int = 10,
) -> list[Rectangle]:
    """Return an upright pole."""
    angles = np.linspace(0, 2 * math.pi, sides + 1)
    ring = np.column_stack([np.cos(angles), np.sin(angles)]) * diameter_m / 2 + centre
    up = np.array([0.0, 0.0, heights_m[1] - heights_m[0]])
    parts = np.array_split(np.arange(texture.shape[1]), sides)
    return [
        Rectangle(
            np.array([*ring[k], heights_m[1]]),
            np.array([*(ring[k + 1] - ring[k]), 0.0]),
            -up,
            np.ascontiguousarray(texture[:, parts[k]]),
            "pole",
        )
        for k in range(sides)
    ]


def solid(
    rng: Random,
    centre: tuple[float, float],
    size_m: tuple[float, float, float],
    yaw_rad: float,
    kind: str = "poster",
    z_m: float = 0.0,
) -> list[Rectangle]:
    """Return a box with its bottom at a height."""
    faces = box(rng, centre, size_m, yaw_rad)
    under = replace(faces[4], origin=faces[4].origin - np.array([0.0, 0.0, size_m[2]]))
    faces = [replace(face, origin=face.origin + np.array([0.0, 0.0, z_m])) for face in [*faces, under]]
    if kind == "poster":
        return faces
    return [
        replace(face, texture=painted(rng, kind, (max(face.width_m, 0.04), max(face.height_m, 0.04)), 300.0))
        for face in faces
    ]


def _room(
    rng: Random,
    floors: list[Rectangle] | None = None,
    kinds: list[str] | None = None,
    low: tuple[float, float] = (-3.0, -3.0),
    high: tuple[float, float] = (4.0, 3.0),
) -> list[Rectangle]:
    kinds = kinds or [str(rng.choice(WALLS)) for _ in range(4)]
    ceiling = painted(rng, "plaster", (high[0] - low[0], high[1] - low[1]), 100.0)
    made = floors if floors is not None else [floor(rng, str(rng.choice(FLOORS)), low, high)]
    return [
        *made,
        *_walls(rng, low, high, kinds),
        Rectangle(
            np.array([*low, CEILING_M]),
            np.array([high[0] - low[0], 0.0, 0.0]),
            np.array([0.0, high[1] - low[1], 0.0]),
            ceiling,
            "ceiling",
        ),
    ]


Made = tuple[list[Rectangle], list[Rectangle], Array]  # the room, the thing, edges (N, 2, 2)
NO_EDGES: Final = np.zeros((0, 2, 2))


def _thing(make: Callable[[Random, tuple[float, float]], list[Rectangle]]) -> Callable[[Random], Made]:
    def made(rng: Random) -> Made:
        room = _room(rng)
        range_m, azimuth = rng.uniform(0.8, 2.6), rng.uniform(-0.4, 0.4)
        return room, make(rng, (range_m * math.cos(azimuth), range_m * math.sin(azimuth))), NO_EDGES

    return made


def _box(low_m: float, high_m: float, kind: str = "poster") -> Callable[[Random, tuple[float, float]], list[Rectangle]]:
    return lambda rng, at: solid(
        rng,
        at,
        (rng.uniform(0.2, 0.6), rng.uniform(0.2, 0.6), rng.uniform(low_m, high_m)),
        rng.uniform(-0.7, 0.7),
        kind,
    )


def _pole(low_m: float, high_m: float, kind: str) -> Callable[[Random, tuple[float, float]], list[Rectangle]]:
    def made(rng: Random, at: tuple[float, float]) -> list[Rectangle]:
        d = rng.uniform(low_m, high_m)
        texture = (
            np.full((16, 40), rng.uniform(20, 235), np.uint8)
            if kind == "one grey"
            else painted(rng, kind, (math.pi * d, 1.8), 500.0)
        )
        return cylinder(at, d, (0.0, 1.8), texture)

    return made


def _bar(rng: Random, at: tuple[float, float]) -> list[Rectangle]:
    """Return a bar of one grey, which differs from the mean of the walls and floors."""
    made = solid(
        rng,
        at,
        (0.04, rng.uniform(0.8, 1.6), rng.uniform(0.03, 0.045)),
        rng.uniform(-0.5, 0.5),
        "plaster",
        rng.uniform(0.2, 1.1),
    )
    texture = np.full((16, 16), rng.choice((30, 60, 220, 245)), np.uint8)
    return [replace(face, texture=texture) for face in made]


def _table(rng: Random, at: tuple[float, float]) -> list[Rectangle]:
    size = rng.uniform(0.6, 0.9), rng.uniform(0.8, 1.4)
    top = solid(rng, (at[0] + 0.3, at[1]), (*size, 0.03), 0.0, "plaster", 0.72)
    legs = [
        leg
        for x in (-1, 1)
        for y in (-1, 1)
        for leg in solid(
            rng,
            (at[0] + 0.3 + x * (size[0] / 2 - 0.05), at[1] + y * (size[1] / 2 - 0.05)),
            (0.04, 0.04, 0.72),
            0.0,
            "plaster",
        )
    ]
    return top + legs


def _tines(rng: Random, at: tuple[float, float]) -> list[Rectangle]:
    return [
        face
        for y in (-0.25, 0.25)
        for face in solid(rng, (at[0] + 0.5, at[1] + y), (1.0, 0.1, 0.05), 0.0, "plaster", rng.uniform(0.05, 0.12))
    ]


def _edge(drop_m: float, *, same: bool) -> Callable[[Random], Made]:
    def made(rng: Random) -> Made:
        at, kind = rng.uniform(1.0, 2.2), str(rng.choice(FLOORS))
        other = kind if same else str(rng.choice([k for k in FLOORS if k != kind]))
        upper = floor(rng, kind, (-3.0, -3.0), (at, 3.0))
        lower = floor(rng, other, (at, -3.0), (5.0, 3.0), -drop_m)
        riser = Rectangle(
            np.array([at, -3.0, 0.0]),
            np.array([0.0, 6.0, 0.0]),
            np.array([0.0, 0.0, -drop_m]),
            painted(rng, "plaster", (6.0, max(drop_m, 0.05)), 200.0),
            "riser",
        )
        room = _room(rng, [upper, lower, riser], high=(5.0, 3.0))
        return room, [], np.array([[[at, -3.0], [at, 3.0]]])

    return made


def _ramp(rng: Random) -> Made:
    at, kind, run = rng.uniform(1.0, 2.0), str(rng.choice(FLOORS)), 2.0
    drop = run * math.tan(math.radians(20))
    upper, lower = floor(rng, kind, (-3.0, -3.0), (at, 3.0)), floor(rng, kind, (at + run, -3.0), (5.5, 3.0), -drop)
    ramp = Rectangle(
        np.array([at, 3.0, 0.0]),
        np.array([run, 0.0, -drop]),
        np.array([0.0, -6.0, 0.0]),
        painted(rng, kind, (run, 6.0), FLOOR_PX_PER_M),
        "floor",
    )
    return _room(rng, [upper, ramp, lower], high=(5.5, 3.0)), [], NO_EDGES


def _white_wall(rng: Random) -> Made:
    at = rng.uniform(1.0, 2.5)
    low, high = (-3.0, -3.0), (at, 3.0)
    return _room(rng, None, ["brick", "granite", "white", "plaster"], low, high), [], NO_EDGES


def _empty(rng: Random) -> Made:
    return _room(rng), [], NO_EDGES


def _corridor(rng: Random) -> Made:
    half = rng.uniform(0.7, 1.0)
    return _room(rng, None, None, (-3.0, -half), (5.0, half)), [], NO_EDGES


CASES: Final[dict[str, Callable[[Random], Made]]] = {
    "room": _empty,
    "corridor": _corridor,
    "white wall": _white_wall,
    "box": _thing(_box(0.3, 1.2)),
    "low box": _thing(_box(0.08, 0.1)),
    "plain box": _thing(_box(0.3, 1.0, "white")),
    "table": _thing(_table),
    "bar": _thing(_bar),
    "tines": _thing(_tines),
    "pole": _thing(_pole(0.02, 0.1, "granite")),
    "plain pole": _thing(_pole(0.04, 0.1, "one grey")),
    "edge 5 cm": _edge(0.05, same=True),
    "edge 8 cm": _edge(0.08, same=True),
    "edge 15 cm": _edge(0.15, same=True),
    "edge 30 cm": _edge(0.3, same=False),
    "edge 50 cm": _edge(0.5, same=True),
    "ramp": _ramp,
    "glossy": _empty,
    "dark": _empty,
    "shadow": _empty,
}


def obstacle_scene(case: str, seed: int) -> ObstacleScene:
    """Return the room of a case."""
    rng = np.random.default_rng([seed, 57, sorted(CASES).index(case)])
    room, thing, edges = CASES[case](rng)
    if case == "shadow":
        room = [_shaded(rng, part) if part.name == "floor" else part for part in room]
    target = np.concatenate([outlines(thing), edges])
    return ObstacleScene(
        case,
        (*room, *thing),
        np.concatenate([outlines(room), target]),
        gloss=0.25 if case == "glossy" else 0.0,
        brightness=0.05 if case == "dark" else 1.0,
        target=target,
    )


def _shaded(rng: Random, part: Rectangle) -> Rectangle:
    """Return a floor with soft cast shadows."""
    height, width = part.texture.shape
    light = np.ones((height, width), np.float32)
    for _ in range(6):
        x, y, w, h = (
            int(value) for value in rng.uniform([0, 0, width / 12, height / 12], [width, height, width / 4, height / 4])
        )
        light[y : y + h, x : x + w] = 0.55
    light = cv2.GaussianBlur(light, (0, 0), 6.0)
    return replace(part, texture=np.clip(np.rint(part.texture * light), 0, 255).astype(np.uint8))


def render_pair(
    scene: ObstacleScene, robot: SimulatedRobot, T_world_base: Array, samples: int = 2
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Return the ideal images of both cameras."""
    T = T_world_base @ robot.rig.T_base_rig
    images = []
    for camera in (robot.rig.lower, robot.rig.upper):
        image = render_grey(Scene(scene.rectangles), camera, T, samples)
        if scene.gloss:
            flags = Scene(tuple(replace(r, texture=WHITE if r.name == "floor" else BLACK) for r in scene.rectangles))
            rest = Scene(tuple(below_floor(r) for r in scene.rectangles if r.name != "floor"))
            on_floor = np.clip(render_grey(flags, camera, T, samples) / 220.0, 0, 1) * scene.gloss
            image = image * (1 - on_floor) + on_floor * render_grey(rest, camera, T, samples)
        images.append(np.asarray(image * np.float32(scene.brightness), np.float32))
    return images[0], images[1]


def base_pose(x_m: float, y_m: float, yaw_rad: float) -> Array:
    """Return T_world_base (4, 4)."""
    return se3.transform(se3.rotation_exp([0.0, 0.0, yaw_rad]), [x_m, y_m, 0.0])
