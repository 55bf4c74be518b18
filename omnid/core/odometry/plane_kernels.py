"""Compiled part of the patches of planes: see plane_patches.py for the equations and the meaning of the arguments."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from omnid.core.compiled import compiled, inner
from omnid.core.odometry.patch_kernels import FARTHEST_PX, LANES, WINDOW_PX

Array = NDArray[np.float64]
Floats = NDArray[np.float32]
Image = NDArray[np.uint8]
Indices = NDArray[np.intp]
Places = NDArray[np.int32]
Bytes = NDArray[np.uint8]

TEMPLATE_PX = WINDOW_PX + 2  # the window and the gradient's border, because that has a pixel on each side
# Twice as large as it should be, because what reaches farther is no patch of this plane.
MAX_REACH_PX = 2.0 * TEMPLATE_PX
MAX_SLOPE = 0.7  # Largest slope of a disparity, because a steeper plane is seen so obliquely that it has no patch.
AROUND_PX = int(2 * MAX_REACH_PX) + 8  # side of a template's source: the reach, and the support of the cubic kernel
# Bits of the second to the fourth grey, because a number of 32 bits holds four of 8.
BYTE, FIRST, SECOND, THIRD = np.int32(255), np.int32(8), np.int32(16), np.int32(24)

ALL_LANES = TEMPLATE_PX * LANES
# Pixels to the right of one, and below it: without a sign, because the compiler then need not look for negative places.
NEXT = (np.uint64(1), np.uint64(2), np.uint64(3))
LINES = (np.uint64(AROUND_PX), np.uint64(2 * AROUND_PX), np.uint64(3 * AROUND_PX))
ZERO, HALF, ONE = np.float32(0.0), np.float32(0.5), np.float32(1.0)
LARGEST_GREY = np.float32(255.0)  # because images have 8 bits
INNER_CUBE, INNER_SQUARE = np.float32(1.5), np.float32(2.5)  # Inner part of the cubic kernel (Keys 1981).


@compiled(
    "(u1[:, ::1], i8[::1], f8[:, ::1], f8[:, ::1], f8[:, ::1], f8[:, :, ::1], f8, f8, f8, f8[:, ::1], u1[:, :, ::1])",
    writes=("templates",),
)
def sample(
    image: Image,
    chosen: Indices,
    centres: Array,
    points: Array,
    slopes: Array,
    T_curr_ref: Array,
    baseline_m: float,
    height_m: float,
    focal_px: float,
    shift: Array,
    templates: Image,
) -> None:
    """Write the templates (N, TEMPLATE, TEMPLATE) of the chosen patches, whose image this is.

    centres (N, 2) [px] in the image, shift (N, 2) [px] of the templates' middle pixels from the centres in the current
    panorama, whose viewpoint is height_m above the lower one.
    """
    H, normal = np.empty((3, 3)), np.empty(3)
    columns, rows = np.empty(ALL_LANES, np.float32), np.empty(ALL_LANES, np.float32)
    four_greys, turns, rays = np.empty(AROUND_PX * AROUND_PX, np.int32), np.empty((2, LANES)), np.empty((3, LANES))
    first, around, found = (
        np.empty(ALL_LANES, np.int32),
        np.empty((4, ALL_LANES), np.int32),
        np.empty(ALL_LANES, np.uint8),
    )
    for k in range(len(four_greys)):
        four_greys[k] = 0
    for lane in range(LANES):
        turns[0, lane] = math.cos((TEMPLATE_PX // 2 - lane) / focal_px)
        turns[1, lane] = math.sin((TEMPLATE_PX // 2 - lane) / focal_px)
    for n in chosen:
        # A place that is NaN or absurd has no template; it would lead out of the image's memory.
        if not (
            abs(shift[n, 0]) <= 1.0
            and abs(shift[n, 1]) <= 1.0  # each by itself: the larger one of a number and NaN may be the number
            and abs(centres[n, 0]) < FARTHEST_PX
            and abs(centres[n, 1]) < FARTHEST_PX
        ):
            for row in range(TEMPLATE_PX):
                for column in range(TEMPLATE_PX):
                    templates[n, row, column] = 0
            continue
        write_normal(points[n], slopes[n], baseline_m, normal)
        height = write_homography(points[n], normal, T_curr_ref[n], height_m, H)
        own_height = points[n, 2] / math.hypot(points[n, 0], points[n, 1])
        write_rays(H, turns, -shift[n, 0] / focal_px, rays)
        write_sources(H, rays, own_height, height, focal_px, shift[n], columns, rows)
        left, top = copy_around(image, columns, rows, centres[n], four_greys)
        x, y = np.float32(centres[n, 0]), np.float32(centres[n, 1])
        write_cubic(four_greys, columns, rows, x, y, left, top, first, around, found)
        for row in range(TEMPLATE_PX):
            for column in range(TEMPLATE_PX):
                templates[n, row, column] = found[row * LANES + column]


@compiled("(f8[:, ::1], f8[:, ::1], f8[:, :, ::1], f8, f8[:, ::1])", writes=("moved",))
def move_slopes(points: Array, slopes: Array, T_curr_ref: Array, baseline_m: float, moved: Array) -> None:
    """Write the slopes (N, 2) of `plane_patches.moved_slopes`."""
    normal, turned, seen = np.empty(3), np.empty(3), np.empty(3)
    for n in range(len(points)):
        T, point = T_curr_ref[n], points[n]
        write_normal(point, slopes[n], baseline_m, normal)
        scale = 1.0
        for a in range(3):
            turned[a] = T[a, 0] * normal[0] + T[a, 1] * normal[1] + T[a, 2] * normal[2]
            seen[a] = T[a, 0] * point[0] + T[a, 1] * point[1] + T[a, 2] * point[2] + T[a, 3]
            scale += turned[a] * T[a, 3]
        # The plane n' . p' = 1 + n' . t has the normal n' / (1 + n' . t).
        per_r = 1 / math.hypot(seen[0], seen[1])
        along = -baseline_m * (seen[0] * turned[1] - seen[1] * turned[0]) * per_r / scale
        down = -baseline_m * turned[2] / scale
        is_patch = abs(along) < MAX_SLOPE and abs(down) < MAX_SLOPE
        moved[n, 0], moved[n, 1] = (along, down) if is_patch else (0.0, 0.0)


@inner
def write_normal(point: Array, slope: Array, baseline_m: float, normal: Array) -> None:
    """Write n (3,) [1/m] of the plane n . p = 1 through a point with slopes (2,) of the disparity.

    The disparity f t / r is f t n . u for the ray u with r = 1, azimuth and the height of u fall by 1 / f from pixel
    to pixel: so the slopes are -t times the components of n along azimuth and axis.
    """
    per_r = 1 / math.hypot(point[0], point[1])
    x, y = point[0] * per_r, point[1] * per_r
    sideways, up = -slope[0] / baseline_m, -slope[1] / baseline_m
    ahead = (1 - up * point[2]) * per_r
    normal[0], normal[1], normal[2] = ahead * x - sideways * y, ahead * y + sideways * x, up


@inner
def write_homography(point: Array, normal: Array, T: Array, height_m: float, H: Array) -> float:
    """Write the homography (3, 3) from rays of the current view to those of the keyframe.

    Both have their azimuth 0 at the patch. Returns z / r of the patch in the current view.
    """
    turned, t, seen = np.empty(3), np.empty(3), np.empty(3)
    for a in range(3):
        turned[a] = T[a, 0] * normal[0] + T[a, 1] * normal[1] + T[a, 2] * normal[2]
        t[a] = T[a, 3]
    t[2] -= height_m
    for a in range(3):
        seen[a] = T[a, 0] * point[0] + T[a, 1] * point[1] + T[a, 2] * point[2] + t[a]
    scale = 1 + turned[0] * t[0] + turned[1] * t[1] + turned[2] * t[2]
    for a in range(3):
        along = T[0, a] * t[0] + T[1, a] * t[1] + T[2, a] * t[2]
        for b in range(3):
            H[a, b] = scale * T[b, a] - along * turned[b]
    r = math.hypot(seen[0], seen[1])
    c, s = seen[0] / r, seen[1] / r
    for a in range(3):
        H[a, 0], H[a, 1] = c * H[a, 0] + s * H[a, 1], c * H[a, 1] - s * H[a, 0]
    height = float(seen[2] / r)
    r = math.hypot(point[0], point[1])
    c, s = point[0] / r, point[1] / r
    for b in range(3):
        H[0, b], H[1, b] = c * H[0, b] + s * H[1, b], c * H[1, b] - s * H[0, b]
    return height


@inner
def write_rays(H: Array, turns: Array, azimuth: float, rays: Array) -> None:
    """Write the rays (3, LANES) of the template's columns at the height 0, in the keyframe.

    turns (2, LANES): cosines and sines of the columns' azimuths about the middle one, whose azimuth is given [rad].
    """
    c, s = math.cos(azimuth), math.sin(azimuth)
    for a in range(3):
        along, across = H[a, 0] * c + H[a, 1] * s, H[a, 1] * c - H[a, 0] * s
        for lane in range(LANES):
            rays[a, lane] = along * turns[0, lane] + across * turns[1, lane]


@inner
def write_sources(
    H: Array,
    rays: Array,
    own_height: float,
    height: float,
    focal_px: float,
    shift: Array,
    columns: Floats,
    rows: Floats,
) -> None:
    """Write where the keyframe shows the template's pixels: offsets [px] from the patch, by row and column.

    The arctangent is its series: an angle of 15 degrees is exact to 1e-7 rad, and a patch is smaller than that.

    own_height, height: z / r of the patch in the keyframe and in the current view. Where the plane explains no patch,
    the offsets are those of the template. The lane after the last column repeats it.
    """
    half, inside, per_focal = TEMPLATE_PX // 2, 0, 1 / focal_px
    h02, h12, h22 = H[0, 2], H[1, 2], H[2, 2]
    for row in range(TEMPLATE_PX):
        h = height - (row - half + shift[1]) * per_focal
        along_of, down_of = columns[row * LANES :], rows[row * LANES :]
        for lane in range(LANES):
            ahead = rays[0, lane] + h02 * h
            per_ahead = 1 / ahead
            tangent = (rays[1, lane] + h12 * h) * per_ahead
            square = tangent * tangent
            along = -focal_px * tangent * (1 - square * (1 / 3 - square * (1 / 5 - square * (1 / 7 - square / 9))))
            down = focal_px * (own_height - (rays[2, lane] + h22 * h) * per_ahead / math.sqrt(1 + square))
            along_of[lane], down_of[lane] = along, down
            is_inside = (ahead > 0) & (abs(along) < MAX_REACH_PX) & (abs(down) < MAX_REACH_PX)  # false for NaN
            inside += is_inside & (lane < TEMPLATE_PX)
        along_of[TEMPLATE_PX], down_of[TEMPLATE_PX] = along_of[TEMPLATE_PX - 1], down_of[TEMPLATE_PX - 1]
    if inside == TEMPLATE_PX * TEMPLATE_PX:
        return
    for row in range(TEMPLATE_PX):
        for lane in range(LANES):
            columns[row * LANES + lane] = min(lane, TEMPLATE_PX - 1) - half + shift[0]
            rows[row * LANES + lane] = row - half + shift[1]


@inner
def copy_around(image: Image, columns: Floats, rows: Floats, centre: Array, four_greys: Places) -> tuple[int, int]:
    """Write the pixels from which a template is interpolated, the border repeated; return the first one's place.

    Each is written with the three to its right, one in each byte, the first in the lowest: what a cubic kernel needs of
    a row is read at once. columns, rows (T LANES,): offsets [px] from the centre (2,), less than MAX_REACH_PX.
    """
    lowest, highest = bounds_of(columns)
    first, last = bounds_of(rows)
    left, top = math.floor(centre[0] + lowest) - 2, math.floor(centre[1] + first) - 2
    right, bottom = math.floor(centre[0] + highest) + 5, math.floor(centre[1] + last) + 5
    (height, width), count = image.shape, -((left - right) // LANES) * LANES
    if left >= 0 and top >= 0 and left + count + 3 <= width and bottom <= height and count <= AROUND_PX:
        for row in range(bottom - top):
            for part in range(0, count, LANES):
                line, to = image[top + row, left + part :], four_greys[row * AROUND_PX + part :]
                for lane in range(LANES):
                    at = np.uint64(lane)
                    to[at] = packed(line[at], line[at + NEXT[0]], line[at + NEXT[1]], line[at + NEXT[2]])
    else:
        for row in range(bottom - top):
            line, to = image[within(top + row, height)], four_greys[row * AROUND_PX :]
            for column in range(right - left):
                a, b = line[within(left + column, width)], line[within(left + column + 1, width)]
                c, d = line[within(left + column + 2, width)], line[within(left + column + 3, width)]
                to[column] = packed(a, b, c, d)
    return left, top


@inner
def bounds_of(offsets: Floats) -> tuple[int, int]:
    """Return the least of offsets (T LANES,) or zero, and the largest or zero, as whole numbers that are not above."""
    least, largest = 0, 0
    for lane in range(ALL_LANES):
        whole = int(np.floor(offsets[lane]))
        least, largest = min(least, whole), max(largest, whole)
    return least, largest


@inner
def packed(a: np.uint8, b: np.uint8, c: np.uint8, d: np.uint8) -> np.int32:
    """Return four greys in the bytes of a number, the first in the lowest."""
    return np.int32(a) | (np.int32(b) << np.int32(8)) | (np.int32(c) << np.int32(16)) | (np.int32(d) << np.int32(24))


@inner
def write_cubic(
    four_greys: Places,
    columns: Floats,
    rows: Floats,
    x: np.float32,
    y: np.float32,
    left: int,
    top: int,
    first: Places,
    around: Places,
    found: Bytes,
) -> None:
    """Write greys (T LANES,) between pixels by cubic convolution (Keys 1981, a = -1/2).

    columns, rows (T LANES,): offsets [px] from x, y; four_greys: see `copy_around`, whose first pixel is that at left,
    top. first (T LANES,), around (4, T LANES): room. Bilinear interpolation shifts fine texture by up to 0.02 px,
    depending on the place between the pixels.
    """
    # Three loops, because one that also reads here and there would not be computed in lanes.
    for lane in range(ALL_LANES):
        whole_column, whole_row = np.floor(x + columns[lane]), np.floor(y + rows[lane])
        first[lane] = (np.int32(whole_row) - np.int32(top + 1)) * np.int32(AROUND_PX) + (
            np.int32(whole_column) - np.int32(left + 1)
        )
    for lane in range(ALL_LANES):
        at = np.uint64(first[lane])
        around[0, lane], around[1, lane] = four_greys[at], four_greys[at + LINES[0]]
        around[2, lane], around[3, lane] = four_greys[at + LINES[1]], four_greys[at + LINES[2]]
    for lane in range(ALL_LANES):
        column, row = x + columns[lane], y + rows[lane]
        u, v = column - np.floor(column), row - np.floor(row)
        p, q = ONE - u, ONE - v
        a, d = -HALF * u * p * p, -HALF * p * u * u
        b, c = ONE + u * u * (INNER_CUBE * u - INNER_SQUARE), ONE + p * p * (INNER_CUBE * p - INNER_SQUARE)
        grey = -HALF * v * q * q * weighted(around[0, lane], a, b, c, d)
        grey += (ONE + v * v * (INNER_CUBE * v - INNER_SQUARE)) * weighted(around[1, lane], a, b, c, d)
        grey += (ONE + q * q * (INNER_CUBE * q - INNER_SQUARE)) * weighted(around[2, lane], a, b, c, d)
        grey += -HALF * q * v * v * weighted(around[3, lane], a, b, c, d)
        found[lane] = np.uint8(np.int32(min(max(grey + HALF, ZERO), LARGEST_GREY)))


@inner
def weighted(four: np.int32, a: np.float32, b: np.float32, c: np.float32, d: np.float32) -> np.float32:
    """Return the sum of four greys in the bytes of a number, by their weights."""
    return (
        a * np.float32(four & BYTE)
        + b * np.float32((four >> FIRST) & BYTE)
        + c * np.float32((four >> SECOND) & BYTE)
        + d * np.float32((four >> THIRD) & BYTE)
    )


@inner
def within(index: int, size: int) -> int:
    """Return the nearest index in [0, size)."""
    return min(max(index, 0), size - 1)
