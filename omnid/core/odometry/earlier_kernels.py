"""Compiled comparison of windows with an earlier panorama: see earlier_view.py."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from omnid.core.compiled import compiled, inner

Array = NDArray[np.float64]
Image = NDArray[np.uint8]
Flags = NDArray[np.bool_]

# Half the side of the windows, by trial on development seeds: with 4, half as many right points again are lost.
HALF_PX = 3


@compiled(
    "(u1[:, ::1], u1[:, ::1], f8[:, ::1], f8[:, ::1], b1[:, ::1], f8, f8, f8, b1[::1])",
    writes=("wrong",),
)
def compare(
    now: Image,
    earlier: Image,
    pixels: Array,
    seen: Array,
    usable: Flags,
    pad_px: float,
    period_px: float,
    least: float,
    wrong: Flags,
) -> None:
    """Write flags (N,) of the pixels (N, 2) of a padded panorama that an earlier one contradicts.

    seen (N, 2): where the earlier one should show their points, in its padded image; usable (H, W): its pixels that
    show the world, without the padding; period_px: columns of a full turn; least: correlation of a point that is
    confirmed. A point that the earlier one does not show is not contradicted, nor is one without a whole window.
    """
    (height, width), columns = now.shape, usable.shape[1]
    # A full turn has a column between its last one and its first one, a sector ends with its last one.
    end = columns if columns >= period_px else columns - 1
    for n in range(len(pixels)):
        wrong[n] = False
        u, v = seen[n, 0] - pad_px, seen[n, 1]
        column, row = int(pixels[n, 0] + pad_px), int(pixels[n, 1])
        # Whole windows, also for the pixels to the right and below; false for NaN.
        if not (0 <= u <= end and HALF_PX <= v < height - HALF_PX - 1 and seen[n, 0] < width - HALF_PX - 1):
            continue
        if min(column, row) < HALF_PX or column >= width - HALF_PX - 1 or row >= height - HALF_PX - 1:
            continue
        if not usable[round(v), min(round(u), columns - 1)]:
            continue
        in_world = correlation(now, earlier, column, row, seen[n, 0], v)
        across = (u - pixels[n, 0] + period_px / 2) % period_px - period_px / 2
        has_moved = math.hypot(across, v - row) > HALF_PX
        wrong[n] = in_world < least or (has_moved and correlation(now, earlier, column, row, column, row) > in_world)


@inner
def correlation(now: Image, earlier: Image, column: int, row: int, x: float, y: float) -> float:
    """Return the correlation of the window about a pixel now with the one about a place between pixels earlier."""
    left, top, pixels = math.floor(x), math.floor(y), (2 * HALF_PX + 1) ** 2
    right, below = x - left, y - top
    a, aa, b, bb, ab = 0.0, 0.0, 0.0, 0.0, 0.0
    for i in range(-HALF_PX, HALF_PX + 1):
        for j in range(-HALF_PX, HALF_PX + 1):
            mine = float(now[row + i, column + j])
            above, under = earlier[top + i], earlier[top + i + 1]
            there = (1 - below) * ((1 - right) * above[left + j] + right * above[left + j + 1])
            there += below * ((1 - right) * under[left + j] + right * under[left + j + 1])
            a, aa, b, bb, ab = a + mine, aa + mine * mine, b + there, bb + there * there, ab + mine * there
    # A window without contrast divides by no zero.
    spread = max(aa - a * a / pixels, 1.0) * max(bb - b * b / pixels, 1.0)
    return (ab - a * b / pixels) / math.sqrt(spread)
