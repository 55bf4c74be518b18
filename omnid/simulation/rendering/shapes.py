"""Textured shapes of rendered worlds: walls, posters on them, and boxes on the floor at z = 0."""

from __future__ import annotations

import numpy as np

from calib.models.camera import Array
from omnid.simulation.rendering import textures
from omnid.simulation.rendering.surfaces import Rectangle, Texture

PX_PER_M = 320.0  # finer than a 768 pixel camera resolves at 0.6 m
CEILING_M = 2.6
Random = np.random.Generator
Point = tuple[float, float]


def painted(rng: Random, kind: str, size_m: Point, px_per_m: float = PX_PER_M) -> Texture:
    """Return a texture of a kind (textures.PAINTERS) for a surface of the given size [m]."""
    size = (max(8, round(size_m[0] * px_per_m)), max(8, round(size_m[1] * px_per_m)))
    return textures.PAINTERS[kind](rng, size, px_per_m)


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
    c, s = np.cos(yaw_rad), np.sin(yaw_rad)
    x, y, up = np.array([c, s, 0]) * size_m[0], np.array([-s, c, 0]) * size_m[1], np.array([0, 0, size_m[2]])
    low = np.array([*centre, 0]) - (x + y) / 2
    # (upper left corner, edge to the right) of each face as seen from outside
    sides = [(low + up, x), (low + x + up, y), (low + x + y + up, -x), (low + y + up, -y)]
    faces = [(a, u, -up) for a, u in sides] + [(low + y + up, x, -y)]
    return [Rectangle(a, u, v, _face(rng, u, v), "box") for a, u, v in faces]


def _face(rng: Random, u: Array, v: Array) -> Texture:
    size = tuple(max(8, round(float(np.linalg.norm(e)) * PX_PER_M)) for e in (u, v))
    return textures.poster(rng, (size[0], size[1]))
