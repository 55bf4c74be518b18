"""Seeded textures of floors of buildings, beside those of omnid's own worlds; all (H, W) uint8."""

from __future__ import annotations

from typing import Final

import numpy as np
from numpy.typing import NDArray

from calib.models.camera import Array
from omnid.simulation.rendering.surfaces import Texture
from omnid.simulation.rendering.textures import PAINTERS, Painter, Random, Size, grey_of, stretched, value_noise


def concrete(rng: Random, size: Size, px_per_m: float) -> Texture:
    """Return smoothed concrete: clouds, pores, and sawn joints every few metres."""
    image = rng.uniform(115, 150) + 5 * value_noise(rng, size, px_per_m * 0.8, 0.75)
    image += 2.5 * value_noise(rng, size, px_per_m * 0.03, 0.9)
    image -= 25 * (value_noise(rng, size, px_per_m * 0.02) > 3.2)
    for axis, apart_m in ((0, rng.uniform(2.2, 3.2)), (1, rng.uniform(2.2, 3.2))):
        _joints(
            image, axis, round(rng.uniform(0.2, 0.8) * apart_m * px_per_m), apart_m * px_per_m, 0.006 * px_per_m, 70
        )
    return grey_of(image)


def glazed(rng: Random, size: Size, px_per_m: float) -> Texture:
    """Return glazed tiles: nearly one grey each, with joints."""
    side_m = rng.choice([0.3, 0.45, 0.6])
    return _flags(rng, size, px_per_m, side_m, 2.5, 1.2, (0.004, rng.uniform(90, 120)))


def slabs(rng: Random, size: Size, px_per_m: float) -> Texture:
    """Return polished stone: dark slabs with thin joints."""
    return _flags(rng, size, px_per_m, 0.6, 3.0, 5.0, (0.002, 60.0), base=rng.uniform(85, 120))


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
    return grey_of(image)


def boards(board_m: tuple[float, float], spread: float, grain: float) -> Painter:
    """Return the painter of boards (length, width) along u, each course beginning elsewhere; spread: of their greys."""

    def paint(rng: Random, size: Size, px_per_m: float) -> Texture:
        length, width = (side_m * px_per_m for side_m in board_m)
        base = rng.uniform(105, 150)
        image = base + grain * stretched(rng, size, px_per_m * 0.03, 14.0)
        for top in np.arange(0, size[1], width):
            course = image[round(top) : round(top + width)]
            first = rng.uniform(0, length)
            ends = np.rint(np.arange(first, size[0] + length, length)).astype(int)
            for begin, end in zip([0, *ends], ends, strict=False):
                course[:, begin:end] += spread * rng.standard_normal()
            _joints(course, 1, int(ends[0]), length, 0.0015 * px_per_m, base - 45)
        _joints(image, 0, 0, width, 0.0015 * px_per_m, base - 45)
        return grey_of(image)

    return paint


def across(painter: Painter) -> Painter:
    """Return the painter of a texture along v instead of u."""
    return lambda rng, size, px_per_m: np.ascontiguousarray(painter(rng, size[::-1], px_per_m).T)


PARQUET: Final = boards((0.6, 0.07), 7.0, 3.0)
FLOOR_PAINTERS: Final[dict[str, Painter]] = {
    **PAINTERS,
    "concrete": concrete,
    "glazed": glazed,
    "slabs": slabs,
    "parquet_along": PARQUET,  # staggered oak staves
    "parquet_across": across(PARQUET),
    "laminate": boards((1.28, 0.19), 2.0, 2.5),  # printed planks with fine joints
}
