"""The paper's building (section V.D): a corridor around rooms with doors and objects, and a path around it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from calib.models.camera import Array
from omnid.simulation.rendering import textures
from omnid.simulation.rendering.shapes import CEILING_M, Point, box, posters
from omnid.simulation.rendering.surfaces import Rectangle, Scene
from tests.simulation.builders import wall
from tests.simulation.paths import planar_poses

PX_PER_M = 200.0  # resolution of floor and ceiling
DOOR_M = (0.95, 2.1)  # width, height
BEND_M = 0.85  # radius of the path in the corners
FAST, SLOW = 2.6, 1.0  # relative speeds on the straight and in a turn
Random = np.random.Generator
KINDS = ("brick", "plaster", "granite", "plaster", "brick", "plain")


@dataclass(frozen=True, slots=True)
class FloorPlan:
    """Outer walls [0, length] x [0, width] m, a corridor along them, and rooms in two rows behind it."""

    length_m: float
    width_m: float
    corridor_m: float
    columns: tuple[float, ...]  # x of the walls between the rooms, both ends included
    middle_m: float  # y of the wall between the rows

    @staticmethod
    def drawn(rng: Random) -> FloorPlan:
        """Return a random plan of about 12 x 9 m."""
        length, width, corridor = rng.uniform(11.5, 12.5), rng.uniform(8.6, 9.4), rng.uniform(1.7, 2.0)
        inner = length - 2 * corridor
        shares = np.cumsum(rng.uniform(0.8, 1.2, 3))
        columns = (corridor, *(corridor + inner * shares / shares[-1]).tolist())
        return FloorPlan(length, width, corridor, columns, width / 2 + rng.uniform(-0.4, 0.4))


def building(seed: int) -> tuple[FloorPlan, Scene]:
    """Return the plan and the scene of a seed."""
    rng = np.random.default_rng([seed, 21])
    plan = FloorPlan.drawn(rng)
    outer = _outer_walls(rng, plan)
    hung = [p for n, side in enumerate(outer) for p in posters(rng, side, round(side.width_m / 1.6), 100 * n)]
    return plan, Scene((*outer, *_floor_and_ceiling(rng, plan), *_rooms(rng, plan), *hung, *_clutter(rng, plan)))


def _outer_walls(rng: Random, plan: FloorPlan) -> list[Rectangle]:
    """Return the left, front, right and back wall of the whole building, seen from inside."""
    corners: list[Point] = [(0, plan.width_m), (plan.length_m, plan.width_m), (plan.length_m, 0), (0, 0)]
    return [wall(rng, str(rng.choice(KINDS)), a, b) for a, b in zip(corners, corners[1:] + corners[:1], strict=True)]


def _floor_and_ceiling(rng: Random, plan: FloorPlan) -> list[Rectangle]:
    along, across = np.array([plan.length_m, 0, 0]), np.array([0, plan.width_m, 0])
    size = (round(plan.length_m * PX_PER_M), round(plan.width_m * PX_PER_M))
    floor, ceiling = (textures.tiles(rng, size, PX_PER_M) for _ in range(2))
    return [
        Rectangle(across, along, -across, floor, "floor"),
        Rectangle(np.array([0, 0, CEILING_M]), along, across, ceiling, "ceiling"),
    ]


def _rooms(rng: Random, plan: FloorPlan) -> list[Rectangle]:
    """Return walls with doors towards the corridor, walls without doors between rooms, and furniture."""
    x0, x1, y0, y1 = plan.columns[0], plan.columns[-1], plan.corridor_m, plan.width_m - plan.corridor_m
    rows: list[tuple[Point, Point]] = []
    for left, right in zip(plan.columns, plan.columns[1:], strict=False):
        rows += [((right, y0), (left, y0)), ((left, y1), (right, y1))]  # as seen from inside the room
    parts = [part for a, b in rows for part in _with_door(rng, wall(rng, str(rng.choice(KINDS)), a, b))]
    inner = [((x, y0), (x, y1)) for x in plan.columns] + [((x0, plan.middle_m), (x1, plan.middle_m))]
    for a, b in inner:
        side = wall(rng, str(rng.choice(KINDS)), a, b)
        parts += [side, *posters(rng, side, 3), *posters(rng, _other_side(side), 3)]
    return parts + [face for centre in _room_centres(plan) for face in _furniture(rng, centre)]


def _other_side(side: Rectangle) -> Rectangle:
    """Return the same wall as seen from behind."""
    return Rectangle(side.origin + side.edge_u, -side.edge_u, side.edge_v, side.texture, side.name)


def _with_door(rng: Random, side: Rectangle) -> list[Rectangle]:
    """Return a wall without the opening of a door: its parts left, right and above; with posters on wide parts."""
    width, height = DOOR_M
    left = rng.uniform(0.3, side.width_m - width - 0.3)
    right = left + width
    pieces = [
        cut(side, (0, 0, left, side.height_m)),
        cut(side, (right, 0, side.width_m - right, side.height_m)),
        cut(side, (left, 0, width, side.height_m - height)),
    ]
    hung = [p for piece in pieces[:2] if piece.width_m > 0.7 for p in posters(rng, _other_side(piece), 1)]
    return pieces + hung


def cut(side: Rectangle, place_m: tuple[float, float, float, float]) -> Rectangle:
    """Return the part of a rectangle at (left, top, width, height) [m] with its texture, to whole pixels."""
    height, width = side.texture.shape
    u, v = width / side.width_m, height / side.height_m
    left, top = round(place_m[0] * u), round(place_m[1] * v)
    right, bottom = round((place_m[0] + place_m[2]) * u), round((place_m[1] + place_m[3]) * v)
    origin = side.origin + left / width * side.edge_u + top / height * side.edge_v
    return Rectangle(
        origin,
        (right - left) / width * side.edge_u,
        (bottom - top) / height * side.edge_v,
        np.ascontiguousarray(side.texture[top:bottom, left:right]),
        side.name,
    )


def _room_centres(plan: FloorPlan) -> list[Point]:
    rows = ((plan.corridor_m + plan.middle_m) / 2, (plan.width_m - plan.corridor_m + plan.middle_m) / 2)
    columns = [(a + b) / 2 for a, b in zip(plan.columns, plan.columns[1:], strict=False)]
    return [(x, y) for x in columns for y in rows]


def _furniture(rng: Random, centre: Point) -> list[Rectangle]:
    """Return a table and a cupboard near the middle of a room."""
    table, cupboard = rng.uniform((0.5, 0.5, 0.5), (0.9, 0.7, 0.9)), rng.uniform((0.3, 0.3, 1.2), (0.6, 0.5, 1.9))
    faces: list[Rectangle] = []
    for side, size in ((-1, table), (1, cupboard)):
        at = (centre[0] + side * rng.uniform(0.35, 0.6), centre[1] + rng.uniform(-0.4, 0.4))
        faces += box(rng, at, (float(size[0]), float(size[1]), float(size[2])), rng.uniform(0, np.pi))
    return faces


def _clutter(rng: Random, plan: FloorPlan) -> list[Rectangle]:
    """Return low boxes along the outer walls, beside the path."""
    faces: list[Rectangle] = []
    for x in np.arange(1.5, plan.length_m - 1.5, 2.6):
        for y in (0.22, plan.width_m - 0.22):
            size = rng.uniform((0.25, 0.15, 0.2), (0.45, 0.25, 0.8))
            faces += box(
                rng,
                (float(x + rng.uniform(-0.6, 0.6)), y),
                (float(size[0]), float(size[1]), float(size[2])),
                rng.uniform(-0.15, 0.15),
            )
    return faces


def round_trip(seed: int, plan: FloorPlan, pairs: int) -> Array:
    """Return poses (pairs, 4, 4) of one round along the corridor, counter-clockwise, back to its start.

    Faster on the straight, slower in the turns, with small sideways waves; the heading follows the path.
    """
    rng = np.random.default_rng([seed, 22])
    xy = _with_waves(rng, _centre_line(plan))
    ahead = np.roll(xy, -1, axis=0) - np.roll(xy, 1, axis=0)
    heading = np.unwrap(np.arctan2(ahead[:, 1], ahead[:, 0]))
    step = np.linalg.norm(np.diff(xy, axis=0, append=xy[:1]), axis=1)
    bend = np.abs(np.gradient(heading)) / np.maximum(step, 1e-9)  # 1/m
    speed = _smooth(np.where(bend > 0.4 / BEND_M, SLOW, FAST), round(0.8 / step.mean()))
    time = np.concatenate([[0], np.cumsum(step / speed)])
    closed = np.vstack([xy, xy[:1]])
    turned = np.append(heading, heading[0] + 2 * np.pi)
    t = np.linspace(0, time[-1], pairs)
    place = np.column_stack([np.interp(t, time, closed[:, 0]), np.interp(t, time, closed[:, 1])])
    return planar_poses(place, np.interp(t, time, turned))


def _centre_line(plan: FloorPlan, spacing_m: float = 0.005) -> Array:
    """Return the middle of the corridor (N, 2), counter-clockwise, with rounded corners."""
    half = plan.corridor_m / 2
    low, high = np.array([half, half]) + BEND_M, np.array([plan.length_m - half, plan.width_m - half]) - BEND_M
    centres = [(high[0], low[1]), (high[0], high[1]), (low[0], high[1]), (low[0], low[1])]
    arcs = []
    for number, centre in enumerate(centres):
        angle = np.linspace(-np.pi / 2, 0, 60) + number * np.pi / 2
        arcs.append(centre + BEND_M * np.column_stack([np.cos(angle), np.sin(angle)]))
    start = np.array([[(low[0] + high[0]) / 2, half]])
    corners = np.vstack([start, *arcs, start])
    arc = np.concatenate([[0], np.cumsum(np.linalg.norm(np.diff(corners, axis=0), axis=1))])
    s = np.linspace(0, arc[-1], round(arc[-1] / spacing_m), endpoint=False)
    return np.column_stack([np.interp(s, arc, corners[:, 0]), np.interp(s, arc, corners[:, 1])])


def _with_waves(rng: Random, line: Array) -> Array:
    """Return the closed line shifted sideways by up to 0.15 m in slow waves."""
    ahead = np.roll(line, -1, axis=0) - np.roll(line, 1, axis=0)
    normal = np.column_stack([-ahead[:, 1], ahead[:, 0]]) / np.linalg.norm(ahead, axis=1, keepdims=True)
    normal = np.column_stack([_smooth(normal[:, k], 61) for k in (0, 1)])
    turn = np.linspace(0, 2 * np.pi, len(line), endpoint=False)
    waves = [rng.uniform(0.02, 0.05) * np.sin(k * turn + rng.uniform(0, 2 * np.pi)) for k in (5, 8, 11)]
    smooth = np.column_stack([_smooth(line[:, k], 61) for k in (0, 1)])
    return np.asarray(smooth + np.sum(waves, axis=0)[:, None] * normal)


def _smooth(values: Array, window: int) -> Array:
    """Return the moving mean (N,) over a window of samples of a closed curve."""
    padded = np.concatenate([values[-window:], values, values[:window]])
    mean = np.convolve(padded, np.ones(window) / window, mode="same")
    return np.asarray(mean[window:-window])
