"""Compiled part of the patches of planes: see plane_patches.py for the equations and the meaning of the arguments."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from omnid.core.compiled import compiled, inner
from omnid.core.odometry.patch_kernels import FARTHEST_PX, LANES, WINDOW_PX, clear

Array = NDArray[np.float64]
Floats = NDArray[np.float32]
Image = NDArray[np.uint8]
Indices = NDArray[np.intp]
Places = NDArray[np.int32]

TEMPLATE_PX = WINDOW_PX + 2  # the window and the gradient's border: a pixel on each side
MAX_REACH_PX = 2.0 * TEMPLATE_PX  # twice as large as it should be: what reaches farther is no patch of this plane
MAX_SLOPE = 0.7  # Largest slope of a disparity: a steeper plane is seen so obliquely that it has no patch.
AROUND_PX = int(2 * MAX_REACH_PX) + 8  # side of a template's source: the reach, and the support of the cubic kernel
FIRST, SECOND, THIRD = np.uint64(1), np.uint64(2), np.uint64(3)
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
    H, normal, greys = np.empty((3, 3)), np.empty(3), np.empty(AROUND_PX * AROUND_PX, np.float32)
    columns, rows = np.empty((TEMPLATE_PX, LANES), np.float32), np.empty((TEMPLATE_PX, LANES), np.float32)
    clear(columns)
    clear(rows)
    for k in range(len(greys)):
        greys[k] = ZERO
    weights, first, found = np.empty((8, LANES), np.float32), np.empty(LANES, np.int32), np.empty(LANES, np.float32)
    for n in chosen:
        # A place that is NaN or absurd has no template; it would lead out of the image's memory.
        if not (
            max(abs(shift[n, 0]), abs(shift[n, 1])) <= 1.0
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
        write_sources(H, own_height, height, focal_px, shift[n], columns, rows)
        left, top = copy_around(image, columns, rows, centres[n], greys)
        x, y = np.float32(centres[n, 0]), np.float32(centres[n, 1])
        for column in range(TEMPLATE_PX):
            write_cubic(greys, columns[column], rows[column], x, y, left, top, weights, first, found)
            for row in range(TEMPLATE_PX):
                templates[n, row, column] = np.uint8(min(max(found[row] + HALF, ZERO), LARGEST_GREY))


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
    aside, up = -slope[0] / baseline_m, -slope[1] / baseline_m
    ahead = (1 - up * point[2]) * per_r
    normal[0], normal[1], normal[2] = ahead * x - aside * y, ahead * y + aside * x, up


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
def write_sources(
    H: Array, own_height: float, height: float, focal_px: float, shift: Array, columns: Floats, rows: Floats
) -> None:
    """Write where the keyframe shows the template's pixels: offsets [px] from the patch, by column and row.

    The arctangent is its series: an angle of 15 degrees is exact to 1e-7 rad, and a patch is smaller than that.

    own_height, height: z / r of the patch in the keyframe and in the current view. Where the plane explains no patch,
    the offsets are those of the template.
    """
    half, inside, per_focal, shift_rows = TEMPLATE_PX // 2, 0, 1 / focal_px, shift[1]
    h02, h12, h22 = H[0, 2], H[1, 2], H[2, 2]
    for column in range(TEMPLATE_PX):
        azimuth = -(column - half + shift[0]) / focal_px
        c, s = math.cos(azimuth), math.sin(azimuth)
        q0, q1, q2 = H[0, 0] * c + H[0, 1] * s, H[1, 0] * c + H[1, 1] * s, H[2, 0] * c + H[2, 1] * s
        along_of, down_of = columns[column], rows[column]
        for row in range(TEMPLATE_PX):
            h = height - (row - half + shift_rows) * per_focal
            ahead = q0 + h02 * h
            per_ahead = 1 / ahead
            tangent = (q1 + h12 * h) * per_ahead
            square = tangent * tangent
            along = -focal_px * tangent * (1 - square * (1 / 3 - square * (1 / 5 - square * (1 / 7 - square / 9))))
            down = focal_px * (own_height - (q2 + h22 * h) * per_ahead / math.sqrt(1 + square))
            along_of[row], down_of[row] = along, down
            inside += (ahead > 0) & (abs(along) < MAX_REACH_PX) & (abs(down) < MAX_REACH_PX)  # false for NaN
    if inside == TEMPLATE_PX * TEMPLATE_PX:
        return
    for column in range(TEMPLATE_PX):
        for row in range(TEMPLATE_PX):
            columns[column, row], rows[column, row] = column - half + shift[0], row - half + shift[1]


@inner
def copy_around(image: Image, columns: Floats, rows: Floats, centre: Array, greys: Floats) -> tuple[int, int]:
    """Write the pixels from which a template is interpolated, the border repeated; return the first one's place.

    columns, rows (T, T): offsets [px] from the centre (2,), less than MAX_REACH_PX.
    """
    lowest, highest, first, last = ZERO, ZERO, ZERO, ZERO
    for column in range(TEMPLATE_PX):
        for row in range(TEMPLATE_PX):
            lowest, highest = min(lowest, columns[column, row]), max(highest, columns[column, row])
            first, last = min(first, rows[column, row]), max(last, rows[column, row])
    left, top = math.floor(centre[0] + lowest) - 2, math.floor(centre[1] + first) - 2
    right, bottom = math.floor(centre[0] + highest) + 4, math.floor(centre[1] + last) + 4
    height, width = image.shape
    if left >= 0 and top >= 0 and right <= width and bottom <= height:
        for row in range(bottom - top):
            for column in range(right - left):
                greys[row * AROUND_PX + column] = np.float32(image[top + row, left + column])
    else:
        for row in range(bottom - top):
            line = image[within(top + row, height)]
            for column in range(right - left):
                greys[row * AROUND_PX + column] = np.float32(line[within(left + column, width)])
    return left, top


@inner
def write_cubic(
    greys: Floats,
    columns: Floats,
    rows: Floats,
    x: np.float32,
    y: np.float32,
    left: int,
    top: int,
    weights: Floats,
    first: Places,
    found: Floats,
) -> None:
    """Write greys (LANES,) between pixels by cubic convolution (Keys 1981, a = -1/2).

    columns, rows (LANES,): offsets [px] from x, y; greys: see `copy_around`, whose first pixel is that at left, top.
    weights (8, LANES), first (LANES,): room. Bilinear interpolation shifts fine texture by up to 0.02 px, depending on
    the place between the pixels.
    """
    for lane in range(LANES):
        column, row = x + columns[lane], y + rows[lane]
        whole_column, whole_row = np.floor(column), np.floor(row)
        first[lane] = (np.int32(whole_row) - np.int32(top + 1)) * np.int32(AROUND_PX) + (
            np.int32(whole_column) - np.int32(left + 1)
        )
        u, v = column - whole_column, row - whole_row
        p, q = ONE - u, ONE - v
        weights[0, lane], weights[3, lane] = -HALF * u * p * p, -HALF * p * u * u
        weights[1, lane] = ONE + u * u * (INNER_CUBE * u - INNER_SQUARE)
        weights[2, lane] = ONE + p * p * (INNER_CUBE * p - INNER_SQUARE)
        weights[4, lane], weights[7, lane] = -HALF * v * q * q, -HALF * q * v * v
        weights[5, lane] = ONE + v * v * (INNER_CUBE * v - INNER_SQUARE)
        weights[6, lane] = ONE + q * q * (INNER_CUBE * q - INNER_SQUARE)
    for lane in range(LANES):
        found[lane] = ZERO
    for k in range(4):
        for lane in range(LANES):
            at = np.uint64(first[lane] + k * AROUND_PX)
            found[lane] += weights[4 + k, lane] * (
                weights[0, lane] * greys[at]
                + weights[1, lane] * greys[at + FIRST]
                + weights[2, lane] * greys[at + SECOND]
                + weights[3, lane] * greys[at + THIRD]
            )


@inner
def within(index: int, size: int) -> int:
    """Return the nearest index in [0, size)."""
    return min(max(index, 0), size - 1)
