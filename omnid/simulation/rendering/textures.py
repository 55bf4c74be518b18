"""Seeded textures: repetitive, natural, printed and nearly empty ones; all (H, W) uint8."""

from __future__ import annotations

from collections.abc import Callable
from typing import Final

import cv2
import numpy as np
from numpy.typing import NDArray

from calib.models.camera import Array
from omnid.simulation.rendering.surfaces import Texture

Random = np.random.Generator
# (width, height) [px]
Size = tuple[int, int]
# Paints a texture by a random generator, a size, and pixels per metre.
Painter = Callable[[Random, Size, float], Texture]


def _grey(values: Array | NDArray[np.float32]) -> Texture:
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
        return _grey(rng.uniform(*greys) + sigma * value_noise(rng, size, coarsest_m * px_per_m, persistence))

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
    return _grey(np.tile(courses, times)[: size[1], : size[0]])


def tiles(rng: Random, size: Size, px_per_m: float) -> Texture:
    """Return grained square tiles with joints, each of its own grey."""
    side, joint = max(4, round(px_per_m * rng.uniform(0.25, 0.45))), max(1, round(px_per_m * 0.006))
    rows, columns = np.arange(size[1]) // side, np.arange(size[0]) // side
    level = rng.uniform(120, 160) + 7 * rng.standard_normal((rows[-1] + 1, columns[-1] + 1))
    image = level[np.ix_(rows, columns)] + 7 * value_noise(rng, size, px_per_m * 0.3, 0.75)
    image[np.arange(size[1]) % side < joint] = 85
    image[:, np.arange(size[0]) % side < joint] = 85
    return _grey(image)


def white(_: Random, size: Size, __: float) -> Texture:
    """Return fresh white paint: one grey level, in which stereo finds nothing."""
    return np.full(size[::-1], 225, np.uint8)


def marbled(rng: Random, size: Size, px_per_m: float) -> Texture:
    """Return linoleum with streaks of two greys along its web."""
    streaks = _stretched(rng, size, px_per_m * 0.06, 3.0)
    return _grey(rng.uniform(120, 160) + 7 * streaks + 4 * value_noise(rng, size, px_per_m * 0.02))


def concrete(rng: Random, size: Size, px_per_m: float) -> Texture:
    """Return smoothed concrete: clouds, pores, and sawn joints every few metres."""
    image = rng.uniform(115, 150) + 5 * value_noise(rng, size, px_per_m * 0.8, 0.75)
    image += 2.5 * value_noise(rng, size, px_per_m * 0.03, 0.9)
    image -= 25 * (value_noise(rng, size, px_per_m * 0.02) > 3.2)
    for axis, apart_m in ((0, rng.uniform(2.2, 3.2)), (1, rng.uniform(2.2, 3.2))):
        _joints(
            image, axis, round(rng.uniform(0.2, 0.8) * apart_m * px_per_m), apart_m * px_per_m, 0.006 * px_per_m, 70
        )
    return _grey(image)


def glazed(rng: Random, size: Size, px_per_m: float) -> Texture:
    """Return glazed tiles: nearly one grey each, with joints."""
    side_m = rng.choice([0.3, 0.45, 0.6])
    return _flags(rng, size, px_per_m, side_m, 2.5, 1.2, (0.004, rng.uniform(90, 120)))


def slabs(rng: Random, size: Size, px_per_m: float) -> Texture:
    """Return polished stone: dark slabs with thin joints."""
    return _flags(rng, size, px_per_m, 0.6, 3.0, 5.0, (0.002, 60.0), base=rng.uniform(85, 120))


def carpet(rng: Random, size: Size, px_per_m: float) -> Texture:
    """Return a pile with a woven pattern that repeats itself."""
    side = round(px_per_m * rng.uniform(0.25, 0.4))
    motif = np.full((side, side), 0.0, np.float32)
    for radius in (0.42, 0.28, 0.12):
        corners = side / 2 * (1 + 2 * radius * np.array([(0, 1), (1, 0), (0, -1), (-1, 0)]))
        cv2.fillPoly(motif, [np.rint(corners).astype(np.int32)], float(rng.choice([-1, 1]) * rng.uniform(8, 22)))
    times = (-(-size[1] // side), -(-size[0] // side))
    return _grey(rng.uniform(75, 120) + np.tile(motif, times)[: size[1], : size[0]] + 6 * value_noise(rng, size, 4.0))


def _stretched(rng: Random, size: Size, coarsest_px: float, times: float) -> NDArray[np.float32]:
    """Return value noise (H, W) whose structures are longer along u."""
    short = max(8, round(size[0] / times))
    return np.asarray(cv2.resize(value_noise(rng, (short, size[1]), coarsest_px), size), np.float32)


def _joints(image: Array | NDArray[np.float32], axis: int, first: int, apart: float, wide: float, grey: float) -> None:
    """Draw lines across an axis of an image; one narrower than a pixel has a part of the grey."""
    lines, part = np.moveaxis(image, axis, 0), min(wide, 1.0)
    for at in np.rint(np.arange(first, len(lines), apart)).astype(int):
        lines[at : at + max(1, round(wide))] += part * (grey - lines[at : at + max(1, round(wide))])


def _flags(
    rng: Random,
    size: Size,
    px_per_m: float,
    side_m: float,
    spread: float,
    grain: float,
    joint: tuple[float, float],
    base: float | None = None,
) -> Texture:
    """Return square flags; joint: width [m] and grey."""
    side = side_m * px_per_m
    first = rng.uniform(0, side, 2)
    rows, columns = (
        ((np.arange(n) + side - offset) // side).astype(int) for n, offset in zip(size[::-1], first, strict=True)
    )
    level = (base or rng.uniform(140, 190)) + spread * rng.standard_normal((rows[-1] + 1, columns[-1] + 1))
    image = level[np.ix_(rows, columns)] + grain * value_noise(rng, size, px_per_m * 0.2, 0.75)
    for axis in (0, 1):
        _joints(image, axis, round(first[axis]), side, joint[0] * px_per_m, joint[1])
    return _grey(image)


def boards(board_m: tuple[float, float], spread: float, grain: float) -> Painter:
    """Return the painter of boards (length, width) along u, each course beginning elsewhere; spread: of their greys."""

    def paint(rng: Random, size: Size, px_per_m: float) -> Texture:
        length, width = (side_m * px_per_m for side_m in board_m)
        base = rng.uniform(105, 150)
        image = base + grain * _stretched(rng, size, px_per_m * 0.03, 14.0)
        for top in np.arange(0, size[1], width):
            course = image[round(top) : round(top + width)]
            first = rng.uniform(0, length)
            ends = np.rint(np.arange(first, size[0] + length, length)).astype(int)
            for begin, end in zip([0, *ends], ends, strict=False):
                course[:, begin:end] += spread * rng.standard_normal()
            _joints(course, 1, int(ends[0]), length, 0.0015 * px_per_m, base - 45)
        _joints(image, 0, 0, width, 0.0015 * px_per_m, base - 45)
        return _grey(image)

    return paint


def across(painter: Painter) -> Painter:
    """Return the painter of a texture along v instead of u."""
    return lambda rng, size, px_per_m: np.ascontiguousarray(painter(rng, size[::-1], px_per_m).T)


PARQUET: Final = boards((0.6, 0.07), 7.0, 3.0)
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
    "concrete": concrete,
    "glazed": glazed,
    "slabs": slabs,
    "carpet": carpet,
    "parquet_along": PARQUET,  # staggered oak staves
    "parquet_across": across(PARQUET),
    "laminate": boards((1.28, 0.19), 2.0, 2.5),  # printed planks with fine joints
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
    return _grey(np.where(value_noise(rng, size, size[0] / 4, 0.5) > 0, light, dark))


def _photograph(rng: Random, size: Size) -> Texture:
    """Return noise of strong contrast with a few ellipses in front."""
    image = _grey(rng.uniform(80, 160) + 45 * value_noise(rng, size, size[0] / 2, 0.6))
    for _ in range(int(rng.integers(2, 6))):
        centre = tuple(int(x) for x in rng.uniform(0, size))
        axes = (int(rng.uniform(0.05, 0.2) * size[0]), int(rng.uniform(0.05, 0.2) * size[1]))
        cv2.ellipse(
            image, centre, axes, float(rng.uniform(0, 180)), 0, 360, float(rng.uniform(10, 245)), -1, cv2.LINE_AA
        )
    return image
