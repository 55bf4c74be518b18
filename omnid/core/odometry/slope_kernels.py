"""Compiled fit of the slopes of disparities: see plane_patches.fitted_slopes."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from omnid.core.compiled import compiled, inner
from omnid.core.odometry.linear_kernels import factorise, solve
from omnid.core.odometry.patch_kernels import LARGEST_GAIN, LEAST_GAIN, MIN_CONTRAST, NOISE_CORRELATION
from omnid.core.odometry.plane_kernels import MAX_SLOPE

Array = NDArray[np.float64]
Image = NDArray[np.uint8]

# Half the side of the window. Slopes err by the third power of it, but a large window leaves the plane. 8
# was tried as well, on thirteen logs of development: set by trial.
HALF_PX = 10
SIDE_PX = 2 * HALF_PX + 1
PIXELS = SIDE_PX * SIDE_PX
UNKNOWNS = 5  # exact: shift along column and row, slopes along column and row, gain
# Px/px, of the start, because those of dense stereo are a third too flat, its windows being upright.
SLOPE_SIGMA = 0.1
# Enough: 59 fits of test_plane_patches.py take 3 to 5. A last step is below the errors: of slopes about 0.008.
ITERATIONS, CONVERGED_PX, CONVERGED_SLOPE = 10, 0.005, 5e-4
MAX_SHIFT_PX = 1.5  # Most distance from where the patch was found before.
DAMPING = 1e-3  # grey^2, of the shifts, so that patches without texture are not singular


@compiled(
    "(u1[:, ::1], u1[:, ::1], f8[:, ::1], f8[:, ::1], f8[:, ::1], f8[::1], f8, f8, f8[:, ::1])", writes=("slopes",)
)
def fit(
    lower: Image,
    upper: Image,
    pixels: Array,
    near: Array,
    start: Array,
    heights: Array,
    focal_px: float,
    noise_grey: float,
    slopes: Array,
) -> None:
    """Write the slopes (N, 2) of patches at pixels (N, 2) of the lower image, seen near pixels (N, 2) of the upper one.

    start (N, 2) stays where the fit fails; heights (N,): z / r of the pixels.
    """
    design, normal = np.empty((UNKNOWNS, SIDE_PX, SIDE_PX)), np.empty((UNKNOWNS, UNKNOWNS))
    for n in range(len(pixels)):
        slopes[n, 0], slopes[n, 1] = start[n, 0], start[n, 1]
        column, row = round(pixels[n, 0]), round(pixels[n, 1])
        height, width = lower.shape
        if min(row, column) <= HALF_PX or row >= height - HALF_PX - 1 or column >= width - HALF_PX - 1:
            continue
        write_design(lower, column, row, design, normal)
        if normal[UNKNOWNS - 1, UNKNOWNS - 1] > PIXELS * MIN_CONTRAST**2:
            iterate(
                upper,
                design,
                normal,
                near[n],
                near[n, 1] - pixels[n, 1],
                heights[n] * focal_px,
                focal_px,
                2 * noise_grey**2,
                slopes[n],
            )


@inner
def write_design(image: Image, column: int, row: int, design: Array, normal: Array) -> None:
    """Write the design (5, SIDE, SIDE), about its means, of the window about a pixel, and its products (5, 5).

    Minus the gradients along column and row (Scharr's 3x3 operator), the second also times the pixel's column and row
    in the window, and the window itself.
    """
    for i in range(-HALF_PX, HALF_PX + 1):
        for j in range(-HALF_PX, HALF_PX + 1):
            r, c = row + i, column + j
            nw, ne, sw, se = 1.0 * image[r - 1, c - 1], image[r - 1, c + 1], image[r + 1, c - 1], image[r + 1, c + 1]
            across = 3 * (nw - ne + sw - se) + 10.0 * image[r, c - 1] - 10.0 * image[r, c + 1]
            down = 3 * (nw - sw + ne - se) + 10.0 * image[r - 1, c] - 10.0 * image[r + 1, c]
            y, x = i + HALF_PX, j + HALF_PX
            design[0, y, x], design[1, y, x] = across / 32, down / 32
            design[2, y, x], design[3, y, x], design[4, y, x] = down / 32 * j, down / 32 * i, image[r, c]
    for a in range(UNKNOWNS):
        total = 0.0
        for y in range(SIDE_PX):
            for x in range(SIDE_PX):
                total += design[a, y, x]
        for y in range(SIDE_PX):
            for x in range(SIDE_PX):
                design[a, y, x] -= total / PIXELS
        for b in range(a + 1):
            product = 0.0
            for y in range(SIDE_PX):
                for x in range(SIDE_PX):
                    product += design[a, y, x] * design[b, y, x]
            normal[a, b] = normal[b, a] = product


@inner
def iterate(
    upper: Image,
    design: Array,
    normal: Array,
    near: Array,
    disparity: float,
    height_px: float,
    focal_px: float,
    noise: float,
    slopes: Array,
) -> None:
    """Set the slopes (2,) by Gauss-Newton, unless it fails; height_px: of the patch above row0."""
    right, weighted, factor = np.empty(UNKNOWNS), np.empty(UNKNOWNS), np.empty((UNKNOWNS, UNKNOWNS))
    solution = np.empty(UNKNOWNS)
    x, y, along, down = 0.0, 0.0, slopes[0], slopes[1]
    gain, variance = 1.0, noise
    for _ in range(ITERATIONS):
        # 1. The window of the upper image, bent by the plane, and its products with the design.
        upright = disparity + y + down * height_px
        energy = project(upper, design, near[0] + x, near[1] + y, upright, along, down, focal_px, right)
        # 2. The step, with the prior of the slopes.
        prior = NOISE_CORRELATION * variance / (gain * SLOPE_SIGMA) ** 2
        for a in range(UNKNOWNS):
            weighted[a] = right[a]
            for b in range(UNKNOWNS):
                factor[a, b] = normal[a, b]
        weighted[2] += prior * gain * (slopes[0] - along)
        weighted[3] += prior * gain * (slopes[1] - down)
        factor[2, 2] += prior
        factor[3, 3] += prior
        factor[0, 0] += DAMPING
        factor[1, 1] += DAMPING
        factorise(factor, factor)
        solve(factor, weighted, solution)
        gain = min(max(solution[4], LEAST_GAIN), LARGEST_GAIN)
        variance = max(residual_of(energy, right, normal, solution) / PIXELS, noise)
        x, y = x + solution[0] / gain, y + solution[1] / gain
        along, down = along + solution[2] / gain, down + solution[3] / gain
        if not (max(abs(x), abs(y)) < MAX_SHIFT_PX and max(abs(along), abs(down)) < MAX_SLOPE):
            return
        if (
            max(abs(solution[2]), abs(solution[3])) < CONVERGED_SLOPE * gain
            and max(abs(solution[0]), abs(solution[1])) < CONVERGED_PX * gain
        ):
            slopes[0], slopes[1] = along, down
            return


@inner
def project(
    upper: Image,
    design: Array,
    column: float,
    row: float,
    upright: float,
    along: float,
    down: float,
    focal_px: float,
    right: Array,
) -> float:
    """Write the products (5,) of the design with the bent window about a pixel; return its energy about the mean.

    On a plane the disparity is linear in the row, and a sine wave of the azimuth: upright is its amplitude where the
    slope along the column is zero.
    """
    energy, total = 0.0, 0.0
    for a in range(UNKNOWNS):
        right[a] = 0.0
    for x in range(SIDE_PX):
        azimuth = (x - HALF_PX) / focal_px
        wave = upright * (math.cos(azimuth) - 1) + along * focal_px * math.sin(azimuth)
        for y in range(SIDE_PX):
            grey = bilinear(upper, column + (x - HALF_PX), row + wave + (1 + down) * (y - HALF_PX))
            for a in range(UNKNOWNS):
                right[a] += design[a, y, x] * grey
            total += grey
            energy += grey * grey
    return energy - total * total / PIXELS


@inner
def residual_of(energy: float, right: Array, normal: Array, solution: Array) -> float:
    """Return the sum of the squared residuals of a solution (5,)."""
    residual = energy
    for a in range(UNKNOWNS):
        residual -= 2 * solution[a] * right[a]
        for b in range(UNKNOWNS):
            residual += solution[a] * normal[a, b] * solution[b]
    return residual


@inner
def bilinear(image: Image, column: float, row: float) -> float:
    """Return the grey between pixels; the border is repeated."""
    height, width = image.shape
    column, row = min(max(column, 0.0), width - 1.001), min(max(row, 0.0), height - 1.001)
    left, top = int(column), int(row)
    x, y = column - left, row - top
    return float(
        (1 - y) * ((1 - x) * image[top, left] + x * image[top, left + 1])
        + y * ((1 - x) * image[top + 1, left] + x * image[top + 1, left + 1])
    )
