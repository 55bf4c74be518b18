"""Compiled correlation of windows of two images."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from omnid.core.compiled import compiled

Array = NDArray[np.float64]
Image = NDArray[np.uint8]


@compiled("(u1[:, ::1], u1[:, ::1], f8[:, ::1], f8[:, ::1], i8, f8[::1])", writes=("found",))
def correlate(a: Image, b: Image, at_a: Array, at_b: Array, half_px: int, found: Array) -> None:
    """Write the correlations (N,) of windows about whole pixels at_a (N, 2) of a with those about places at_b of b.

    Greys between pixels are interpolated. A window without contrast has none; those that leave an image are NaN.
    """
    pixels, reach = float((2 * half_px + 1) ** 2), half_px + 1
    for n in range(len(found)):
        column, row = int(at_a[n, 0]), int(at_a[n, 1])
        left, top = math.floor(at_b[n, 0]), math.floor(at_b[n, 1])
        found[n] = math.nan
        if min(column, row, left, top) < reach or max(column, left) >= a.shape[1] - reach:
            continue
        if max(row, top) >= a.shape[0] - reach:
            continue
        u, v = at_b[n, 0] - left, at_b[n, 1] - top
        x, xx, y, yy, xy = 0.0, 0.0, 0.0, 0.0, 0.0
        for i in range(-half_px, half_px + 1):
            for j in range(-half_px, half_px + 1):
                mine = float(a[row + i, column + j])
                above, below = b[top + i], b[top + i + 1]
                there = (1 - v) * ((1 - u) * above[left + j] + u * above[left + j + 1])
                there += v * ((1 - u) * below[left + j] + u * below[left + j + 1])
                x, xx, y, yy, xy = x + mine, xx + mine * mine, y + there, yy + there * there, xy + mine * there
        spread = max(xx - x * x / pixels, 1.0) * max(yy - y * y / pixels, 1.0)
        found[n] = (xy - x * y / pixels) / math.sqrt(spread)
