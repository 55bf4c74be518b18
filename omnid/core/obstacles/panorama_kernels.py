"""Compiled loops over panoramas: band-passes, normalised ones, and the bounds of half a row about each pixel.

Means over rows are sums of 64 bits that go on from row to row, and rows beyond a border are those mirrored at it, as in
OpenCV, with the same results.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from omnid.core.compiled import compiled, inner

Bytes = NDArray[np.uint8]
Floats = NDArray[np.float32]
Doubles = NDArray[np.float64]
Numbers = NDArray[np.int32]

NOTHING, GREYEST = np.float32(0.0), np.float32(255.0)  # limits, because a normalised image has 8 bits
STEPS_PER_ROW = 32  # Places between two rows, as many as in OpenCV because results are to be the same.


@inner
def mirrored(row: int, count: int) -> int:
    """Return a row of so many, or the one that lies in the place of one beyond a border."""
    return count - 1 - abs(count - 1 - abs(row))


@inner
def add_row(row: Floats, sign: float, sums: Doubles) -> None:
    """Add a row (W,), or take it away."""
    for u in range(len(sums)):
        sums[u] += sign * row[u]


@inner
def row_means(image: Floats, rows: int, sums: Doubles, into: Floats) -> None:
    """Write the means (H, W) of an image over an odd number of rows."""
    height, half, scale = len(image), rows // 2, 1.0 / rows
    sums[:] = 0.0
    for v in range(-half, half):
        add_row(image[mirrored(v, height)], 1.0, sums)
    for v in range(height):
        new, old, mean = image[mirrored(v + half, height)], image[mirrored(v - half, height)], into[v]
        for u in range(len(sums)):
            total = sums[u] + new[u]
            mean[u] = np.float32(total * scale)
            sums[u] = total - old[u]


@compiled("(f4[:, ::1], i8, f4[:, ::1])", writes=("band",))
def band_pass(smooth: Floats, rows: int, band: Floats) -> None:
    """Write an image (H, W) less its mean along columns, over an odd number of rows and taken twice."""
    once, sums = np.empty_like(smooth), np.empty(smooth.shape[1], np.float64)
    row_means(smooth, rows, sums, once)
    row_means(once, rows, sums, band)
    for v in range(len(band)):
        mine, band_row = smooth[v], band[v]
        for u in range(len(band_row)):
            band_row[u] = mine[u] - band_row[u]


@inner
def add_bounded(mine: Floats, other: Floats, most: np.float32, sums: Floats) -> None:
    """Add to sums (W,) by how much a row exceeds another one, at most `most` either way."""
    for u in range(len(sums)):
        above = mine[u] - other[u]
        above = above if above < most else most
        sums[u] += above if above > -most else -most


@compiled("(f4[:, ::1], i8, f4, f4[:, ::1])", writes=("band",))
def bounded_band_pass(smooth: Floats, rows: int, most: np.float32, band: Floats) -> None:
    """Write by how much the pixels of an image (H, W) exceed those of their column, in the mean of an odd number of
    rows, of which each counts `most` at most: a strong edge hides no weak texture around it."""
    height, half = len(smooth), rows // 2
    for v in range(height):
        band[v] = NOTHING
        for other in range(v - half, v + half + 1):
            add_bounded(smooth[v], smooth[mirrored(other, height)], most, band[v])
        for u in range(band.shape[1]):
            band[v, u] /= np.float32(rows)


@inner
def add_three(row: Floats, sums: Doubles) -> None:
    """Add to sums (W,) those of three neighbours of a row (W + 2,)."""
    for u in range(len(sums)):
        sums[u] += np.float64(row[u]) + np.float64(row[u + 1]) + np.float64(row[u + 2])


@inner
def squares(band: Floats, into: Floats) -> None:
    """Write the squares (W + 2,) of a row (W,), mirrored at both ends."""
    width = len(band)
    for u in range(width):
        into[u + 1] = band[u] * band[u]
    into[0], into[width + 1] = into[2], into[width - 1]


@compiled("(f4[:, ::1], i8, f4, f4, f4, f4, u1[:, ::1])", writes=("into",))
def normalise(band: Floats, rows: int, share2: float, noise2: float, units: float, zero: float, into: Bytes) -> None:
    """Write a band-pass (H, W) in units of what two views of it differ by.

    rows: of its contrast. The difference of two views has the variance share2 * contrast^2 + noise2; zero: level
    without texture, units: levels in one sigma.
    """
    height, width = band.shape
    band2, sums = np.empty((height, width + 2), np.float32), np.zeros(width, np.float64)
    for v in range(height):
        squares(band[v], band2[v])
    half, scale = rows // 2, 1.0 / (3 * rows)
    for v in range(-half, half):
        add_three(band2[mirrored(v, height)], sums)
    for v in range(height):
        add_three(band2[mirrored(v + half, height)], sums)
        mine, found = band[v], into[v]
        for u in range(width):
            contrast2 = np.float32(sums[u] * scale)
            level = mine[u] * units / np.float32(math.sqrt(contrast2 * share2 + noise2)) + zero
            level = level if level > NOTHING else NOTHING
            found[u] = np.uint8(np.int32(level if level < GREYEST else GREYEST))
        old = band2[mirrored(v - half, height)]
        for u in range(width):
            sums[u] -= np.float64(old[u]) + np.float64(old[u + 1]) + np.float64(old[u + 2])


@inner
def half_way(a: np.uint8, b: np.uint8) -> np.uint8:
    """Return the mean of two numbers, of which a half is rounded to the even one."""
    apart = np.uint8(a ^ b)
    mean = np.uint8(np.uint8(a & b) + np.uint8(apart >> np.uint8(1)))
    return np.uint8(mean + np.uint8(np.uint8(apart & mean) & np.uint8(1)))


@inner
def row_bounds(above: Bytes, mine: Bytes, below: Bytes, least: Bytes, most: Bytes) -> None:
    """Write the least and the most (W,) within half a row of each pixel of a row."""
    for u in range(len(mine)):
        pixel = mine[u]
        up, down = half_way(pixel, above[u]), half_way(pixel, below[u])
        low = up if up < down else down
        high = down if up < down else up
        least[u] = low if low < pixel else pixel
        most[u] = high if high > pixel else pixel


@compiled("(u1[:, ::1], u1[:, :, ::1])", writes=("into",))
def bounds(image: Bytes, into: Bytes) -> None:
    """Write the least and the most (2, H, W) of an image (H, W) within half a row of each pixel."""
    last = len(image) - 1
    for v in range(len(image)):
        row_bounds(image[max(v - 1, 0)], image[v], image[min(v + 1, last)], into[0, v], into[1, v])


@compiled("(u1[:, ::1], i4[::1], u1[:, :, ::1])", writes=("into",))
def bounds_on_plane(image: Bytes, steps: Numbers, into: Bytes) -> None:
    """Write the same of the image whose rows are those of an image (H, W) at steps (H,) by STEPS_PER_ROW."""
    plane, last = np.empty_like(image), len(image) - 1
    for v in range(len(image)):
        row = steps[v] // STEPS_PER_ROW
        share = np.uint16(steps[v] % STEPS_PER_ROW)
        rest, half = np.uint16(STEPS_PER_ROW - share), np.uint16(STEPS_PER_ROW // 2)
        one, two = image[min(row, last)], image[min(row + 1, last)]
        for u in range(image.shape[1]):
            between = np.uint16(np.uint16(one[u]) * rest + np.uint16(two[u]) * share + half)
            plane[v, u] = np.uint8(between >> np.uint16(5))
    for v in range(len(image)):
        row_bounds(plane[max(v - 1, 0)], plane[v], plane[min(v + 1, last)], into[0, v], into[1, v])
