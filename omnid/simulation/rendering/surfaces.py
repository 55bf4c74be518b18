"""Surfaces of rendered worlds: seeded textures; flat textured rectangles, posters, and boxes on the floor at z = 0.

Textures are repetitive, natural, printed or nearly empty; all are (H, W) uint8.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from functools import cached_property
from typing import Final, TypeAlias

import cv2
import numpy as np
from numpy.typing import NDArray

from calib.models.camera import Array

Texture = NDArray[np.uint8]
Random = np.random.Generator
# (width, height) [px]
Size = tuple[int, int]
# Paints a texture by a random generator, a size, and pixels per metre.
Painter = Callable[[Random, Size, float], Texture]
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


# 1. Textures.
def grey_of(values: Array | NDArray[np.float32]) -> Texture:
    """Return values (H, W) as whole grey levels."""
    rounded = np.rint(values)
    return np.clip(rounded, 0, 255, out=rounded).astype(np.uint8)


def value_noise(rng: Random, size: Size, coarsest_px: float, persistence: float = 0.6) -> NDArray[np.float32]:
    """Return noise (H, W) float32 of mean 0 and standard deviation 1 with all scales from coarsest_px to 2 pixels."""
    width, height = size
    total, weight = np.zeros((height, width), np.float32), 1.0
    while coarsest_px >= 2:
        cells = (int(width / coarsest_px) + 2, int(height / coarsest_px) + 2)
        grid = rng.standard_normal(cells[::-1]).astype(np.float32)
        octave = cv2.resize(grid, (width, height), interpolation=cv2.INTER_CUBIC)
        total += np.multiply(octave, weight, out=octave)
        coarsest_px, weight = coarsest_px / 2, weight * persistence
    mean, sigma = total.mean(), max(float(total.std()), 1e-6)
    total -= mean
    total /= sigma
    return total


def clouds(greys: tuple[float, float], sigma: float, coarsest_m: float, persistence: float) -> Painter:
    """Return the painter of noise of a standard deviation and a spectrum about a grey of a range."""

    def paint(rng: Random, size: Size, px_per_m: float) -> Texture:
        return grey_of(rng.uniform(*greys) + sigma * value_noise(rng, size, coarsest_m * px_per_m, persistence))

    return paint


def brick(rng: Random, size: Size, px_per_m: float) -> Texture:
    """Return a running bond of identical bricks: one pair of courses, repeated."""
    length, course = round(px_per_m * rng.uniform(0.22, 0.32)), round(px_per_m * rng.uniform(0.075, 0.11))
    joint = max(1, round(px_per_m * rng.uniform(0.008, 0.014)))
    face, mortar = rng.uniform(60, 110), rng.uniform(140, 190)
    one = face + 4 * value_noise(rng, (length, course), course / 2)
    one[:joint], one[:, :joint] = mortar, mortar
    courses = np.vstack([one, np.roll(one, length // 2, axis=1)])
    times = (-(-size[1] // courses.shape[0]), -(-size[0] // length))
    return grey_of(np.tile(courses, times)[: size[1], : size[0]])


def tiles(rng: Random, size: Size, px_per_m: float) -> Texture:
    """Return grained square tiles with joints, each of its own grey."""
    side, joint = max(4, round(px_per_m * rng.uniform(0.25, 0.45))), max(1, round(px_per_m * 0.006))
    rows, columns = np.arange(size[1]) // side, np.arange(size[0]) // side
    level = rng.uniform(120, 160) + 7 * rng.standard_normal((rows[-1] + 1, columns[-1] + 1))
    image = level[np.ix_(rows, columns)] + 7 * value_noise(rng, size, px_per_m * 0.3, 0.75)
    image[np.arange(size[1]) % side < joint] = 85
    image[:, np.arange(size[0]) % side < joint] = 85
    return grey_of(image)


def white(_: Random, size: Size, __: float) -> Texture:
    """Return fresh white paint: one grey level, in which stereo finds nothing."""
    return np.full(size[::-1], 225, np.uint8)


def marbled(rng: Random, size: Size, px_per_m: float) -> Texture:
    """Return linoleum with streaks of two greys along its web."""
    streaks = stretched(rng, size, px_per_m * 0.06, 3.0)
    return grey_of(rng.uniform(120, 160) + 7 * streaks + 4 * value_noise(rng, size, px_per_m * 0.02))


def carpet(rng: Random, size: Size, px_per_m: float) -> Texture:
    """Return a pile with a woven pattern that repeats itself."""
    side = round(px_per_m * rng.uniform(0.25, 0.4))
    motif = np.full((side, side), 0.0, np.float32)
    for radius in (0.42, 0.28, 0.12):
        corners = side / 2 * (1 + 2 * radius * np.array([(0, 1), (1, 0), (0, -1), (-1, 0)]))
        cv2.fillPoly(motif, [np.rint(corners).astype(np.int32)], float(rng.choice([-1, 1]) * rng.uniform(8, 22)))
    times = (-(-size[1] // side), -(-size[0] // side))
    return grey_of(rng.uniform(75, 120) + np.tile(motif, times)[: size[1], : size[0]] + 6 * value_noise(rng, size, 4.0))


def stretched(rng: Random, size: Size, coarsest_px: float, times: float) -> NDArray[np.float32]:
    """Return value noise (H, W) whose structures are longer along u."""
    short = max(8, round(size[0] / times))
    return np.asarray(cv2.resize(value_noise(rng, (short, size[1]), coarsest_px), size), np.float32)


PAINTERS: Final[dict[str, Painter]] = {
    "brick": brick,
    "plaster": clouds((115, 165), 11, 0.5, 0.7),  # a soft cloudy wall with fine grain
    "granite": clouds((100, 140), 42, 0.4, 0.75),  # strong contrast at every scale
    "tiles": tiles,
    "plain": clouds((130, 180), 1.2, 1.0, 0.35),  # paint with nearly no texture: a few grey levels of coarse clouds
    "white": white,
    "linoleum": clouds((115, 175), 0.8, 1.5, 0.8),  # one grey, with a little dirt and grain
    "epoxy": clouds((150, 190), 0.9, 0.8, 0.4),  # a cast floor with the broad waves of the trowel
    "marbled": marbled,
    "carpet": carpet,
}


def poster(rng: Random, size: Size) -> Texture:
    """Return a printed page, a drawing, two-tone shapes or a photograph, at random."""
    kinds = (_page, _drawing, _blobs, _photograph)
    return kinds[rng.integers(len(kinds))](rng, size)


def _page(rng: Random, size: Size) -> Texture:
    """Return lines of letters on white paper; a mirrored image of letters is recognised."""
    page = np.full(size[::-1], rng.uniform(215, 245), np.uint8)
    height = max(10, size[1] // int(rng.integers(8, 16)))
    for bottom in range(2 * height, size[1] - height, height):
        text = "".join(chr(c) for c in rng.integers(65, 91, 200))
        cv2.putText(page, text, (height, bottom), cv2.FONT_HERSHEY_SIMPLEX, height / 34, 25, max(1, height // 12))
    page[:, size[0] - height :] = page[0, 0]
    return page


def _drawing(rng: Random, size: Size) -> Texture:
    """Return lines and filled shapes of any grey."""
    sheet = np.full(size[::-1], rng.uniform(60, 220), np.uint8)
    for _ in range(int(rng.integers(12, 30))):
        a, b = (tuple(int(x) for x in rng.uniform(0, size)) for _ in range(2))
        cv2.line(sheet, a, b, float(rng.uniform(10, 245)), int(rng.integers(1, max(3, size[0] // 25))), cv2.LINE_AA)
        cv2.circle(sheet, a, int(rng.uniform(0.02, 0.1) * size[0]), float(rng.uniform(10, 245)), -1, cv2.LINE_AA)
    return sheet


def _blobs(rng: Random, size: Size) -> Texture:
    """Return two tones with wavy outlines."""
    dark, light = rng.uniform(15, 80), rng.uniform(150, 240)
    return grey_of(np.where(value_noise(rng, size, size[0] / 4, 0.5) > 0, light, dark))


def _photograph(rng: Random, size: Size) -> Texture:
    """Return noise of strong contrast with a few ellipses in front."""
    image = grey_of(rng.uniform(80, 160) + 45 * value_noise(rng, size, size[0] / 2, 0.6))
    for _ in range(int(rng.integers(2, 6))):
        centre = tuple(int(x) for x in rng.uniform(0, size))
        axes = (int(rng.uniform(0.05, 0.2) * size[0]), int(rng.uniform(0.05, 0.2) * size[1]))
        cv2.ellipse(
            image, centre, axes, float(rng.uniform(0, 180)), 0, 360, float(rng.uniform(10, 245)), -1, cv2.LINE_AA
        )
    return image


# 2. Rectangles, posters and boxes.
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

    @cached_property
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


Scene: TypeAlias = tuple[Rectangle, ...]  # of a world


def painted(rng: Random, kind: str, size_m: Point, px_per_m: float = PX_PER_M) -> Texture:
    """Return a texture of a kind (PAINTERS) for a surface of the given size [m]."""
    return PAINTERS[kind](rng, pixels_of(size_m, px_per_m), px_per_m)


def pixels_of(sides_m: Point, px_per_m: float) -> Size:
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
        texture = poster(rng, (round(width * 500), round(height * 500)))
        hung.append(on.poster(texture, (left, top, width, height), f"poster{first + i}"))
    return hung


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
    return [Rectangle(a, u, v, paint((float(np.linalg.norm(u)), float(np.linalg.norm(v)))), name) for a, u, v in faces]


def poster_paint(rng: Random) -> Paint:
    """Return what paints a face as a printed page, a drawing or a photograph."""
    return lambda sides_m: poster(rng, pixels_of(sides_m, PX_PER_M))
