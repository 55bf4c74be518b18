"""Compiled correlation of windows with an earlier panorama: see earlier_view.py."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from omnid.core.compiled import compiled, inner

Array = NDArray[np.float64]
Image = NDArray[np.uint8]
Indices = NDArray[np.int64]

# Half the side of the windows, by trial on development seeds: with 4, half as many right points again are lost.
HALF_PX = 3
# Exact.
PIXELS = (2 * HALF_PX + 1) ** 2
FLAT = 1.0  # grey^2, of a window: so that one without contrast divides by no zero


@compiled("(u1[:, ::1], u1[:, ::1], i8[:, ::1], f8[:, ::1], f8[:, ::1])", writes=("found",))
def correlate(now: Image, earlier: Image, pixels: Indices, seen: Array, found: Array) -> None:
    """Write correlations (N, 2) of the windows about pixels (N, 2) of an image with those of an earlier one.

    The first is with the window about seen (N, 2), the second with that about the same pixel. NaN where a window leaves
    the image.
    """
    height, width = now.shape
    for n in range(len(pixels)):
        column, row = pixels[n, 0], pixels[n, 1]
        left, top = math.floor(seen[n, 0]), math.floor(seen[n, 1])
        found[n, 0] = found[n, 1] = math.nan
        if min(column, row, left, top) < HALF_PX or max(column, left + 1) >= width - HALF_PX:
            continue
        if max(row, top + 1) >= height - HALF_PX:
            continue
        right, below = seen[n, 0] - left, seen[n, 1] - top
        w00, w01, w10, w11 = (1 - below) * (1 - right), (1 - below) * right, below * (1 - right), below * right
        # Sums of both windows of the earlier image in one loop, so that the additions do not wait for each other.
        a = aa = b = bb = ab = c = cc = ac = 0.0
        for y in range(-HALF_PX, HALF_PX + 1):
            for x in range(-HALF_PX, HALF_PX + 1):
                here, same, k, m = float(now[row + y, column + x]), earlier[row + y, column + x], top + y, left + x
                there = w00 * earlier[k, m] + w01 * earlier[k, m + 1]
                there += w10 * earlier[k + 1, m] + w11 * earlier[k + 1, m + 1]
                a, aa = a + here, aa + here * here
                b, bb, ab = b + there, bb + there * there, ab + here * there
                c, cc, ac = c + same, cc + float(same) * same, ac + here * same
        found[n, 0], found[n, 1] = correlation(a, aa, b, bb, ab), correlation(a, aa, c, cc, ac)


@inner
def correlation(a: float, aa: float, b: float, bb: float, ab: float) -> float:
    """Return the correlation of two windows from their sums, those of their squares and that of their products."""
    spread = max(aa - a * a / PIXELS, FLAT) * max(bb - b * b / PIXELS, FLAT)
    return (ab - a * b / PIXELS) / math.sqrt(spread)
