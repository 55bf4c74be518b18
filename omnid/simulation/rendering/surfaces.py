"""Surfaces of rendered worlds: flat textured rectangles, posters on walls, and boxes on the floor at z = 0."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np

from calib.models.camera import Array
from omnid.simulation.rendering import textures
from omnid.simulation.rendering.textures import Random, Texture

PX_PER_M = 320.0  # finer than a 768 pixel camera resolves at 0.6 m
CEILING_M = 2.6
Point = tuple[float, float]
Paint = Callable[[Point], Texture]  # of a face, by its sides [m]
# Distance of a poster from its wall: well above the depth error of float32.
POSTER_GAP_M = 0.002
# Unit vector towards the light in the world. Its components differ, so that adjacent faces differ in grey.
LIGHT = np.array([0.35, 0.55, 0.76])
# Factors of the light from all sides and of that from LIGHT; the sum is 1, so no surface is brighter than its texture.
AMBIENT, DIFFUSE = 0.72, 0.28


@dataclass(frozen=True)
class Rectangle:
    """A flat image in the world, seen from both sides.

    origin (3,) [m] is the upper left corner of texture (H, W) uint8, edge_u (3,) runs along its upper border and
    edge_v (3,) along its left one; texture pixel centres lie at (i + 0.5) / W and (j + 0.5) / H of the edges.
    """

    origin: Array
    edge_u: Array
    edge_v: Array
    texture: Texture = field(repr=False)
    name: str = ""

    @property
    def width_m(self) -> float:
        """Return the length of edge_u [m]."""
        return float(np.linalg.norm(self.edge_u))

    @property
    def height_m(self) -> float:
        """Return the length of edge_v [m]."""
        return float(np.linalg.norm(self.edge_v))

    @cached_property
    def normal(self) -> Array:
        """Return the unit normal (3,), away from the side on which the texture is not mirrored."""
        n = np.cross(self.edge_u, self.edge_v)
        return np.asarray(n / np.linalg.norm(n))

    @property
    def corners(self) -> Array:
        """Return the four corners (4, 3) [m]: upper left, upper right, lower right, lower left."""
        return self.points(np.array([[0, 0], [1, 0], [1, 1], [0, 1.0]]))

    def points(self, uv: Array) -> Array:
        """Return world points (N, 3) [m] at fractions uv (N, 2) of the edges."""
        return np.asarray(self.origin + uv[:, :1] * self.edge_u + uv[:, 1:] * self.edge_v)

    @cached_property
    def brightness(self) -> float:
        """Return the factor of the texture's grey by the angle to the light, equal on both sides."""
        return float(AMBIENT + DIFFUSE * abs(self.normal @ LIGHT))

    def poster(self, texture: Texture, area_m: tuple[float, float, float, float], name: str = "") -> Rectangle:
        """Return a poster just in front of this wall; area_m = (left, top, width, height) along the edges."""
        u, v = self.edge_u / self.width_m, self.edge_v / self.height_m
        left, top, width, height = area_m
        origin = self.origin + left * u + top * v - POSTER_GAP_M * self.normal
        return Rectangle(origin, width * u, height * v, texture, name)


@dataclass(frozen=True)
class Scene:
    """The rectangles of a world."""

    rectangles: tuple[Rectangle, ...]

    def named(self, name: str) -> Rectangle:
        """Return the first rectangle with this name."""
        return next(r for r in self.rectangles if r.name == name)


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


def poster_paint(rng: Random) -> Paint:
    """Return what paints a face as a printed page, a drawing or a photograph."""
    return lambda sides_m: textures.poster(rng, pixels_of(sides_m, PX_PER_M))
