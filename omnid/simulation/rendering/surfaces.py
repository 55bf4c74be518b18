"""Surfaces of rendered worlds: flat textured rectangles."""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from calib.models.camera import Array

Texture = NDArray[np.uint8]
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
