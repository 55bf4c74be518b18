"""Seeded worlds: a corridor between two walls, and a room with boxes; floor at z = 0, x along the corridor."""

from __future__ import annotations

from functools import lru_cache

import numpy as np

from omnid.simulation.rendering.shapes import CEILING_M, Point, Random, box, painted, posters
from omnid.simulation.rendering.surfaces import Rectangle, Scene

# Number of worlds of each kind that are kept, as many tests show the same; their textures are a few megabytes each.
KEPT = 6


def wall(rng: Random, kind: str, left: Point, right: Point) -> Rectangle:
    """Return a wall from floor to ceiling between two points (x, y) [m], left and right as seen from inside."""
    a, b = np.array([*left, CEILING_M]), np.array([*right, CEILING_M])
    return Rectangle(
        a, b - a, np.array([0, 0, -CEILING_M]), painted(rng, kind, (float(np.linalg.norm(b - a)), CEILING_M)), kind
    )


def _flat(rng: Random, kind: str, low: Point, high: Point) -> tuple[Rectangle, Rectangle]:
    """Return floor (of that kind) and ceiling (tiles) between two corners (x, y) [m]."""
    (x0, y0), (x1, y1) = low, high
    size = (x1 - x0, y1 - y0)
    along = np.array([x1 - x0, 0.0, 0])
    floor = Rectangle(np.array([x0, y1, 0]), along, np.array([0, y0 - y1, 0.0]), painted(rng, kind, size), "floor")
    ceiling = Rectangle(
        np.array([x0, y0, CEILING_M]), along, np.array([0, y1 - y0, 0.0]), painted(rng, "tiles", size), "ceiling"
    )
    return floor, ceiling


def _enclosed(rng: Random, kinds: tuple[str, ...], low: Point, high: Point) -> list[Rectangle]:
    """Return left (+y), right (-y), front (+x) and back wall, then floor and ceiling, of a box-shaped space."""
    (x0, y0), (x1, y1) = low, high
    ends = [((x0, y1), (x1, y1)), ((x1, y0), (x0, y0)), ((x1, y1), (x1, y0)), ((x0, y0), (x0, y1))]
    walls = [wall(rng, kind, a, b) for kind, (a, b) in zip(kinds[:4], ends, strict=True)]
    return [*walls, *_flat(rng, kinds[4], low, high)]


@lru_cache(KEPT)
def corridor(seed: int, length_m: float = 8.0, kinds: tuple[str, ...] | None = None, posters_per_8m: int = 6) -> Scene:
    """Return two walls 1.5 to 3 m apart along x with end walls, floor, ceiling, posters and a few low boxes.

    x runs from -2 to length_m - 2, y = 0 lies between the walls. kinds: textures of the left, right, front and back
    wall and the floor; by default one of the two walls is brick and the other one is random.
    """
    rng = np.random.default_rng([seed, 1])
    if kinds is None:
        pair = ["brick", str(rng.choice(["brick", "plaster", "granite"]))]
        rng.shuffle(pair)
        kinds = (*pair, str(rng.choice(["brick", "granite"])), str(rng.choice(["granite", "plaster"])), "tiles")
    left, right = rng.uniform(0.9, 1.6), -rng.uniform(0.8, 1.4)
    space = _enclosed(rng, kinds, (-2.0, right), (length_m - 2.0, left))
    long, short = max(1, round(posters_per_8m * length_m / 8)), min(posters_per_8m, 2)
    hung: list[Rectangle] = []
    for side, count in zip(space[:4], (long, long, short, short), strict=True):
        hung += posters(rng, side, count, len(hung))
    boxes = [face for x in np.arange(-1.2, length_m - 2.5, 2.2) for face in _by_a_wall(rng, x, (right, left))]
    return Scene((*space, *hung, *boxes))


def _by_a_wall(rng: Random, x: float, walls: Point) -> list[Rectangle]:
    """Return a low box at one of the walls y = walls[0] or walls[1]."""
    size = (rng.uniform(0.2, 0.4), rng.uniform(0.15, 0.25), rng.uniform(0.25, 0.8))
    at_left = bool(rng.integers(2))
    y = walls[1] - 0.2 if at_left else walls[0] + 0.2
    return box(rng, (x + rng.uniform(-0.5, 0.5), y), size, rng.uniform(-0.15, 0.15))


@lru_cache(KEPT)
def room(seed: int, size_m: Point = (6.0, 5.0), boxes: int = 8, kinds: tuple[str, ...] | None = None) -> Scene:
    """Return a room about the origin with posters and boxes up to 1.5 m high at its walls; 1.3 m around 0 are free."""
    rng = np.random.default_rng([seed, 2])
    half = (size_m[0] / 2, size_m[1] / 2)
    drawn = tuple(str(k) for k in rng.choice(["brick", "plaster", "granite", "plain"], 4))
    space = _enclosed(rng, kinds or (*drawn, "tiles"), (-half[0], -half[1]), half)
    hung: list[Rectangle] = []
    for side in space[:4]:
        hung += posters(rng, side, 3, len(hung))
    standing: list[Rectangle] = []
    for angle in np.linspace(0, 2 * np.pi, boxes, endpoint=False) + rng.uniform(0, 1):
        radius = 0.8 * min(half[0] / max(abs(np.cos(angle)), 1e-3), half[1] / max(abs(np.sin(angle)), 1e-3))
        size = tuple(rng.uniform((0.3, 0.3, 0.4), (0.6, 0.6, 1.5)))
        at = (float(radius * np.cos(angle)), float(radius * np.sin(angle)))
        standing += box(rng, at, (size[0], size[1], size[2]), rng.uniform(0, np.pi))
    return Scene((*space, *hung, *standing))
