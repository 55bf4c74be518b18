"""Compiled comparison of windows with an earlier panorama: see earlier_view.py."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from omnid.core.compiled import compiled, inner

Array = NDArray[np.float64]
Bytes = NDArray[np.uint8]
Flags = NDArray[np.bool_]
Places = NDArray[np.int32]

# Half the side of the windows, by trial on development seeds: with 4, half as many right points again are lost.
HALF_PX = 3
# Exact.
SIDE_PX = 2 * HALF_PX + 1
PIXELS = SIDE_PX**2
FLAT = 1.0  # grey^2, of a window: so that one without contrast divides by no zero
# Columns of a window that are read at once, SIDE_PX of them count: eight because the compiler then reads eight bytes.
LANES = 8
# Exact: where the window about the same pixel begins, and that about the place where the point was seen.
SAME, SEEN = SIDE_PX * LANES, 2 * SIDE_PX * LANES
NEXT = np.uint64(1)  # exact
# Between pixels, weights are multiples of 1 / STEPS^2, and greys of 1 / SCALE, so that sums are of whole numbers, which
# the compiler adds in any order. 64 steps are exact to 4 grey levels where a pixel is black and the next one white.
STEPS, SCALE = np.int32(64), np.int32(16)
HALF_GREY, SHIFT = np.int32(128), np.int32(8)  # exact: STEPS^2 / SCALE is 2^8, and half of it is rounded up


@compiled(
    "(u1[::1], u1[::1], i8, i8, f8[:, ::1], f8[:, ::1], b1[:, ::1], f8, f8, f8, b1[::1])",
    writes=("wrong",),
)
def compare(
    now: Bytes,
    earlier: Bytes,
    height: int,
    width: int,
    pixels: Array,
    seen: Array,
    usable: Flags,
    pad_px: float,
    period_px: float,
    least: float,
    wrong: Flags,
) -> None:
    """Write flags (N,) of the pixels (N, 2) of a padded panorama that an earlier one (height * width,) contradicts.

    seen (N, 2): where the earlier one should show their points, in its padded image; usable (H, W): its pixels that
    show the world, without the padding; period_px: columns of a full turn; least: correlation of a point that is
    confirmed. A point that the earlier one does not show is not contradicted, nor is one without a whole window.
    """
    room = np.empty(SEEN + SIDE_PX * LANES, np.int32)
    # A full turn has a column between its last one and its first one, a sector ends with its last one.
    columns = usable.shape[1]
    end = columns if columns >= period_px else columns - 1
    for n in range(len(pixels)):
        wrong[n] = False
        u, v = seen[n, 0] - pad_px, seen[n, 1]
        if not (0 <= u <= end and abs(v) < height):  # false for NaN
            continue
        at_column, at_row = min(round(u), columns - 1), min(max(round(v), 0), height - 1)
        if not usable[at_row, at_column]:
            continue
        column, row = int(pixels[n, 0] + pad_px), int(pixels[n, 1])
        left, top = math.floor(seen[n, 0]), math.floor(v)
        if min(column, row, left, top) < HALF_PX or max(column, left) + LANES - HALF_PX >= width:
            continue
        if max(row, top + 1) >= height - HALF_PX:
            continue
        copy_windows(now, earlier, width, column, row, seen[n], room)
        in_world, on_rig = correlations(room)
        across = (u - pixels[n, 0] + period_px / 2) % period_px - period_px / 2
        has_moved = math.hypot(across, v - pixels[n, 1]) > HALF_PX
        wrong[n] = in_world < least or (has_moved and on_rig > in_world)


@inner
def copy_windows(now: Bytes, earlier: Bytes, width: int, column: int, row: int, seen: Array, room: Places) -> None:
    """Write three windows: about a pixel now, about the same pixel earlier, and about a place there between pixels."""
    left, top = math.floor(seen[0]), math.floor(seen[1])
    right, below = np.int32((seen[0] - left) * STEPS), np.int32((seen[1] - top) * STEPS)
    w00, w01 = (STEPS - below) * (STEPS - right), (STEPS - below) * right
    w10, w11 = below * (STEPS - right), below * right
    for y in range(SIDE_PX):
        at, to = np.uint64((row + y - HALF_PX) * width + column - HALF_PX), np.uint64(y * LANES)
        # A loop for each window, because one that writes here and there would not be computed in lanes.
        for lane in range(LANES):
            room[to + np.uint64(lane)] = np.int32(now[at + np.uint64(lane)])
        for lane in range(LANES):
            room[to + np.uint64(SAME + lane)] = np.int32(earlier[at + np.uint64(lane)])
        at = np.uint64((top + y - HALF_PX) * width + left - HALF_PX)
        under = at + np.uint64(width)
        for lane in range(LANES):
            k = np.uint64(lane)
            grey = w00 * np.int32(earlier[at + k]) + w01 * np.int32(earlier[at + k + NEXT])
            grey += w10 * np.int32(earlier[under + k]) + w11 * np.int32(earlier[under + k + NEXT])
            room[to + np.uint64(SEEN + lane)] = (grey + HALF_GREY) >> SHIFT
        room[to + np.uint64(SIDE_PX)] = 0
        room[to + np.uint64(SAME + SIDE_PX)] = 0
        room[to + np.uint64(SEEN + SIDE_PX)] = 0


@inner
def correlations(room: Places) -> tuple[float, float]:
    """Return the correlations of a window with the one about the place where it was seen, and about the same pixel."""
    a = aa = b = bb = ab = c = cc = ac = np.int32(0)
    for k in range(SAME):
        mine, same, there = room[np.uint64(k)], room[np.uint64(k + SAME)], room[np.uint64(k + SEEN)]
        a += mine
        aa += mine * mine
        b += there
        bb += there * there
        ab += mine * there
        c += same
        cc += same * same
        ac += mine * same
    one, square = float(a), float(aa)
    in_world = correlation(one, square, b / SCALE, bb / (SCALE * SCALE), ab / SCALE)
    return in_world, correlation(one, square, float(c), float(cc), float(ac))


@inner
def correlation(a: float, aa: float, b: float, bb: float, ab: float) -> float:
    """Return the correlation of two windows from their sums, those of their squares and that of their products."""
    spread = max(aa - a * a / PIXELS, FLAT) * max(bb - b * b / PIXELS, FLAT)
    return (ab - a * b / PIXELS) / math.sqrt(spread)
