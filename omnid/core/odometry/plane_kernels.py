"""Compiled part of the patches of planes: see plane_patches.py for the equations and the meaning of the arguments."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from omnid.core.compiled import compiled, inner
from omnid.core.odometry.patch_kernels import WINDOW_PX

Array = NDArray[np.float64]
Floats = NDArray[np.float32]
Image = NDArray[np.uint8]
Indices = NDArray[np.intp]

TEMPLATE_PX = WINDOW_PX + 2  # holds the window and the gradient's border
MAX_REACH_PX = 2.0 * TEMPLATE_PX  # a patch that reaches farther in the keyframe is no patch of this plane
MAX_SLOPE = 0.7  # of a disparity: a steeper plane is seen so much aslant that it has no patch
ZERO, HALF, ONE, LARGEST_GREY = np.float32(0.0), np.float32(0.5), np.float32(1.0), np.float32(255.0)
INNER_CUBE, INNER_SQUARE = np.float32(1.5), np.float32(2.5)  # coefficients of the inner part of Keys' kernel


@compiled("(u1[:, ::1], i8[::1], f8[:, ::1], f8[:, ::1], f8[:, ::1], f8[:, :, ::1], f8, f8, f8, f8[:, ::1], "
          "u1[:, :, ::1])", writes=("templates",))
def sample(image: Image, chosen: Indices, centres: Array, points: Array, slopes: Array, T_curr_ref: Array,
           baseline_m: float, height_m: float, focal_px: float, shift: Array, templates: Image) -> None:
    """Write the templates (N, TEMPLATE, TEMPLATE) of the chosen patches, whose image this is.

    centres (N, 2) [px] in the image, shift (N, 2) [px] of the templates' middle pixels from the centres in the current
    panorama, whose viewpoint is height_m above the lower one.
    """
    H, normal = np.empty((3, 3)), np.empty(3)
    columns, rows = np.empty((TEMPLATE_PX, TEMPLATE_PX), np.float32), np.empty((TEMPLATE_PX, TEMPLATE_PX), np.float32)
    for n in chosen:
        write_normal(points[n], slopes[n], baseline_m, normal)
        height = write_homography(points[n], normal, T_curr_ref[n], height_m, H)
        own_height = points[n, 2] / math.hypot(points[n, 0], points[n, 1])
        write_sources(H, own_height, height, focal_px, shift[n], columns, rows)
        left, top = np.float32(centres[n, 0]), np.float32(centres[n, 1])
        for row in range(TEMPLATE_PX):
            for column in range(TEMPLATE_PX):
                grey = cubic(image, left + columns[row, column], top + rows[row, column])
                templates[n, row, column] = np.uint8(min(max(grey + HALF, ZERO), LARGEST_GREY))


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
def write_sources(H: Array, own_height: float, height: float, focal_px: float, shift: Array, columns: Floats,
                  rows: Floats) -> None:
    """Write where the keyframe shows the template's pixels: offsets [px] from the patch.

    own_height, height: z / r of the patch in the keyframe and in the current view. Where the plane explains no patch,
    the offsets are those of the template.
    """
    half, farthest = TEMPLATE_PX // 2, 0.0
    for column in range(TEMPLATE_PX):
        azimuth = -(column - half + shift[0]) / focal_px
        c, s = math.cos(azimuth), math.sin(azimuth)
        q0, q1, q2 = H[0, 0] * c + H[0, 1] * s, H[1, 0] * c + H[1, 1] * s, H[2, 0] * c + H[2, 1] * s
        for row in range(TEMPLATE_PX):
            h = height - (row - half + shift[1]) / focal_px
            ahead = q0 + H[0, 2] * h
            tangent = (q1 + H[1, 2] * h) / ahead
            along = -focal_px * math.atan(tangent)
            down = focal_px * (own_height - (q2 + H[2, 2] * h) / (ahead * math.sqrt(1 + tangent * tangent)))
            columns[row, column], rows[row, column] = along, down
            reach = max(abs(along), abs(down))
            if not (ahead > 0 and reach < MAX_REACH_PX):  # true for NaN as well
                farthest = MAX_REACH_PX
    if farthest < MAX_REACH_PX:
        return
    for row in range(TEMPLATE_PX):
        for column in range(TEMPLATE_PX):
            columns[row, column], rows[row, column] = column - half + shift[0], row - half + shift[1]


@inner
def cubic(image: Image, column: np.float32, row: np.float32) -> np.float32:
    """Return the grey between pixels by cubic convolution (Keys 1981, a = -1/2); the border is repeated.

    Bilinear interpolation shifts fine texture by up to 0.02 px, depending on the place between the pixels.
    """
    height, width = image.shape
    left, top = math.floor(column), math.floor(row)
    x, y = column - np.float32(left), row - np.float32(top)
    u, v = ONE - x, ONE - y
    w0, w3 = -HALF * x * u * u, -HALF * u * x * x
    w1, w2 = ONE + x * x * (INNER_CUBE * x - INNER_SQUARE), ONE + u * u * (INNER_CUBE * u - INNER_SQUARE)
    v0, v3 = -HALF * y * v * v, -HALF * v * y * y
    v1, v2 = ONE + y * y * (INNER_CUBE * y - INNER_SQUARE), ONE + v * v * (INNER_CUBE * v - INNER_SQUARE)
    a, b, c, d = left - 1, left, left + 1, left + 2
    e, f, g, h = top - 1, top, top + 1, top + 2
    if a < 0 or e < 0 or d >= width or h >= height:
        a, b, c, d = within(a, width), within(b, width), within(c, width), within(d, width)
        e, f, g, h = within(e, height), within(f, height), within(g, height), within(h, height)
    first, second, third, fourth = image[e], image[f], image[g], image[h]
    return (v0 * (w0 * np.float32(first[a]) + w1 * np.float32(first[b]) + w2 * np.float32(first[c])
                  + w3 * np.float32(first[d]))
            + v1 * (w0 * np.float32(second[a]) + w1 * np.float32(second[b]) + w2 * np.float32(second[c])
                    + w3 * np.float32(second[d]))
            + v2 * (w0 * np.float32(third[a]) + w1 * np.float32(third[b]) + w2 * np.float32(third[c])
                    + w3 * np.float32(third[d]))
            + v3 * (w0 * np.float32(fourth[a]) + w1 * np.float32(fourth[b]) + w2 * np.float32(fourth[c])
                    + w3 * np.float32(fourth[d])))


@inner
def within(index: int, size: int) -> int:
    """Return the nearest index in [0, size)."""
    return min(max(index, 0), size - 1)
