"""Textured shapes of rendered worlds: walls, posters on them, and boxes on the floor at z = 0."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from calib.models.camera import Array
from omnid.simulation.rendering import textures
from omnid.simulation.rendering.surfaces import Rectangle, Texture

PX_PER_M = 320.0  # finer than a 768 pixel camera resolves at 0.6 m
CEILING_M = 2.6
Random = np.random.Generator
Point = tuple[float, float]
Paint = Callable[[Point], Texture]  # of a face, by its sides [m]


def painted(rng: Random, kind: str, size_m: Point, px_per_m: float = PX_PER_M) -> Texture:
    """Return a texture of a kind (textures.PAINTERS) for a surface of the given size [m]."""
    return textures.PAINTERS[kind](rng, pixels_of(size_m, px_per_m), px_per_m)


def pixels_of(sides_m: Point, px_per_m: float) -> textures.Size:
    """Return the width and height [px] of the texture of a surface, at least 8 px each."""
    width, height = (max(8, round(side_m * px_per_m)) for side_m in sides_m)
    return width, height


def posters(rng: Random, on: Rectangle, count: int, first: int = 0) -> list[Rectangle]:
    """Return posters at random places of a wall, one per equal stretch so that they do not overlap."""
    stretch, hung = on.width_m / max(count, 1), []
    for i in range(count):
        width = min(rng.uniform(0.25, 0.6), 0.8 * stretch)
        height = rng.uniform(0.25, 0.6)
        left = i * stretch + rng.uniform(0, stretch - width)
        top = rng.uniform(0.5, CEILING_M - 0.9 - height)
        texture = textures.poster(rng, (round(width * 500), round(height * 500)))
        hung.append(on.poster(texture, (left, top, width, height), f"poster{first + i}"))
    return hung


def box(rng: Random, centre: Point, size_m: tuple[float, float, float], yaw_rad: float) -> list[Rectangle]:
    """Return a box on the floor: four sides and the top, each with a texture of its own."""
    return solid((*centre, 0.0), size_m, yaw_rad, poster_paint(rng), is_raised=False)


def solid(
    at: tuple[float, float, float],
    size_m: tuple[float, float, float],
    yaw_rad: float,
    paint: Paint,
    *,
    is_raised: bool = True,
    name: str = "box",
) -> list[Rectangle]:
    """Return a box: four sides, the top, and the bottom of a raised one; at: the middle of its bottom."""
    c, s = np.cos(yaw_rad), np.sin(yaw_rad)
    x, y, up = np.array([c, s, 0]) * size_m[0], np.array([-s, c, 0]) * size_m[1], np.array([0, 0, size_m[2]])
    low = np.array(at, float) - (x + y) / 2
    # (upper left corner, edge to the right) of each face as seen from outside
    sides = [(low + up, x), (low + x + up, y), (low + x + y + up, -x), (low + y + up, -y)]
    faces = [(a, u, -up) for a, u in sides] + [(low + y + up, x, -y), (low, x, y)][: 1 + is_raised]
    return [Rectangle(a, u, v, paint((_length(u), _length(v))), name) for a, u, v in faces]


def _length(edge: Array) -> float:
    return float(np.linalg.norm(edge))


def poster_paint(rng: Random, px_per_m: float = PX_PER_M) -> Paint:
    """Return what paints a face as a printed page, a drawing or a photograph."""
    return lambda sides_m: textures.poster(rng, pixels_of(sides_m, px_per_m))
