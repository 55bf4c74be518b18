"""Compiled part of the patches of planes, see plane_patches.py for the equations and the arguments; correlation."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from omnid.core.compiled import compiled, inner
from omnid.core.stereo.view_kernels import moved, turned

Array = NDArray[np.float64]
Vector = tuple[float, float, float]
Floats = NDArray[np.float32]
Image = NDArray[np.uint8]
Flags = NDArray[np.bool_]
Indices = NDArray[np.intp]
Integers = NDArray[np.int32]

# Enough: 98 % of the patches of test_plane_patches.py end before; a last step is below the hundredths that noise
# leaves.
ITERATIONS, CONVERGED_PX = 12, 0.01
LARGEST_GAIN = 4.0  # and the inverse of the least one; exposures were made equal before
MIN_CONTRAST = 0.5  # grey levels, standard deviation in a window, because less is no texture
# Determinant of the gradients' matrix by its squared trace, because less is an edge, along which a patch slides.
MIN_DETERMINANT = 1e-3
# Interpolation correlates the noise of neighbouring pixels, so that a sum over a window of a panorama varies by this
# factor more.
NOISE_CORRELATION = 3.0
# Variance of a gradient of the panorama's noise per variance of the noise, which enlarges the gradients' matrix, and
# the least share of that matrix that counts as texture.
GRADIENT_NOISE, MIN_TRUE_GRADIENT = 0.12, 0.2
MAX_SLOPE = 0.7  # Largest slope of a disparity: steeper planes are seen too obliquely for a patch.
MIDDLE_GREY = np.float32(128)  # is subtracted, so that sums of float32 lose less


@compiled("(u1[:, ::1], f8[:, ::1], f8[:, :], f8[:, :], UniTuple(f8, 3), f4[:, :, ::1])", writes=("templates",))
def sample(image: Image, centres: Array, planes: Array, T: Array, lengths: Vector, templates: Floats) -> None:
    """Write the templates (N, T, T) of patches of an image.

    centres (N, 2) [px] in the image; the others: see `write_map`.
    """
    side, half = templates.shape[1], templates.shape[1] // 2
    cell, part, places = np.empty((0, 0), np.float32), np.empty(4, np.float32), np.empty((2, side * side), np.float32)
    x, y, weights = places[0], places[1], np.empty((2, 4, side * side), np.float32)
    by_x, by_y = weights[0], weights[1]
    nodes, powers = np.empty((2, 3, 3)), np.empty((2, 3, 3))
    columns, rows = powers[0], powers[1]
    for n in range(len(templates)):
        write_map(planes[n], T, lengths, half, nodes, powers)
        reach_px = max(reach_of(columns, half), reach_of(rows, half))
        # A place that is unknown or outside has no template.
        if not (0 <= centres[n, 0] < image.shape[1] and 0 <= centres[n, 1] < image.shape[0]) or math.isnan(reach_px):
            templates[n] = 0.0
            continue
        # 1. The pixels that the template and the cubic kernel reach.
        reach = math.ceil(reach_px) + 1
        width = 2 * reach + 3
        if len(cell) < width:
            cell = np.empty((width, width), np.float32)
        left, top = math.floor(centres[n, 0]) - reach, math.floor(centres[n, 1]) - reach
        copy_cell(image, left, top, width, width, cell)
        # 2. The places of the template's pixels in between.
        for i in range(side):
            t = float(i - half)
            x0 = np.float32(centres[n, 0] - left + columns[0, 0] + t * (columns[1, 0] + t * columns[2, 0]))
            x1 = np.float32(columns[0, 1] + t * (columns[1, 1] + t * columns[2, 1]))
            x2 = np.float32(columns[0, 2] + t * (columns[1, 2] + t * columns[2, 2]))
            y0 = np.float32(centres[n, 1] - top + rows[0, 0] + t * (rows[1, 0] + t * rows[2, 0]))
            y1 = np.float32(rows[0, 1] + t * (rows[1, 1] + t * rows[2, 1]))
            y2 = np.float32(rows[0, 2] + t * (rows[1, 2] + t * rows[2, 2]))
            for j in range(side):
                s = np.float32(j - half)
                x[i * side + j], y[i * side + j] = x0 + s * (x1 + s * x2), y0 + s * (y1 + s * y2)
        # 3. The greys there, by cubic convolution: bilinear interpolation shifts fine texture by up to 0.02 px.
        write_keys(x, by_x)
        write_keys(y, by_y)
        greys = templates[n].ravel()
        for k in range(side * side):
            row, first = np.int32(y[k]), np.int32(x[k]) - 1
            above, here, below, last = cell[row - 1], cell[row], cell[row + 1], cell[row + 2]
            a, b, c, d = by_y[0, k], by_y[1, k], by_y[2, k], by_y[3, k]
            for m in range(first, first + 4):
                part[m - first] = a * above[m] + b * here[m] + c * below[m] + d * last[m]
            a, b, c, d = by_x[0, k], by_x[1, k], by_x[2, k], by_x[3, k]
            greys[k] = (a * part[0] + b * part[1]) + (c * part[2] + d * part[3])


@inner
def normal_of(p: Array, slopes: Array, baseline_m: float) -> Vector:
    """Return n [1/m] of the plane n . p = 1 through a point with slopes of the disparity.

    The disparity f t / r is f t n . u for the ray u with r = 1, azimuth and the height of u fall by 1 / f from pixel
    to pixel: so the slopes are -t times the components of n along azimuth and axis.
    """
    r = math.hypot(p[0], p[1])
    x, y, sideways, up = p[0] / r, p[1] / r, -slopes[0] / baseline_m, -slopes[1] / baseline_m
    ahead = (1 - up * p[2]) / r
    return ahead * x - sideways * y, ahead * y + sideways * x, up


@compiled("(f8[:, :], f8[:, :], f8[:, :, :], f8, f8[:, ::1])", writes=("result",))
def write_moved_slopes(points: Array, slopes: Array, T_curr_ref: Array, baseline_m: float, result: Array) -> None:
    """Write the slopes (N, 2) of planes in other frames; zero where the plane is seen nearly edge on."""
    for k in range(len(points)):
        T = T_curr_ref[k]
        n, (x, y, _) = turned(T, normal_of(points[k], slopes[k], baseline_m)), moved(T, points[k])
        # The plane n' . p' = 1 + n' . t has the normal n' / (1 + n' . t).
        scale = 1 + n[0] * T[0, 3] + n[1] * T[1, 3] + n[2] * T[2, 3]
        along, up = (x * n[1] - y * n[0]) / (math.hypot(x, y) * scale), n[2] / scale
        is_seen = max(abs(along), abs(up)) * baseline_m < MAX_SLOPE
        result[k, 0], result[k, 1] = (-baseline_m * along, -baseline_m * up) if is_seen else (0.0, 0.0)


@inner
def write_map(plane: Array, T: Array, lengths: Vector, half: int, nodes: Array, powers: Array) -> None:
    """Write powers (2, 3, 3) of rows and columns from a template's middle, for those from the patch's centre.

    plane (7,): its point and its slopes in the frame of the patch, and where the current view shows the point [px]. T:
    to the current frame. lengths: focal length [px], baseline, height of the current viewpoint above the lower one [m].
    half: of a template [px]. nodes: room for (2, 3, 3).
    """
    # 1. The plane n' . (p' - o') = scale, and the point, from the current viewpoint o'.
    (focal_px, baseline_m, height_m), p, predicted = lengths, plane[:3], plane[5:]
    n, (x, y, z) = turned(T, normal_of(p, plane[3:5], baseline_m)), moved(T, p)
    t = T[0, 3], T[1, 3], T[2, 3] - height_m
    scale = 1 + n[0] * t[0] + n[1] * t[1] + n[2] * t[2]
    r, azimuth, rise = math.hypot(p[0], p[1]), math.atan2(y, x), (z - height_m) / math.hypot(x, y)
    right, below = np.rint(predicted[0]) - predicted[0], np.rint(predicted[1]) - predicted[1]
    is_bent = scale > 0
    for j in range(3):
        # 2. The rays of corners, middles of the sides and middle, of length 1 across; azimuth falls with the column.
        turn = azimuth - (half * (j - 1) + right) / focal_px
        u, v = math.cos(turn), math.sin(turn)
        for i in range(3):
            w = rise - (half * (i - 1) + below) / focal_px
            # 3. Their points on the plane, in the frame of the image, with the azimuth of the patch as x axis.
            along = u * n[0] + v * n[1] + w * n[2]
            reach = scale / along
            a, b, c = u * reach - t[0], v * reach - t[1], w * reach - t[2]
            x, y = T[0, 0] * a + T[1, 0] * b + T[2, 0] * c, T[0, 1] * a + T[1, 1] * b + T[2, 1] * c
            high = T[0, 2] * a + T[1, 2] * b + T[2, 2] * c
            ahead, left = (x * p[0] + y * p[1]) / r, (y * p[0] - x * p[1]) / r
            nodes[0, i, j] = -focal_px * math.atan2(left, ahead)
            nodes[1, i, j] = focal_px * (p[2] / r - high / math.hypot(ahead, left))
            is_bent &= along > 0 and ahead > 0 and max(abs(nodes[0, i, j]), abs(nodes[1, i, j])) < 4 * half + 2
    for i in range(3):
        for j in range(3):
            if not is_bent:
                nodes[0, i, j], nodes[1, i, j] = half * (j - 1) + right, half * (i - 1) + below
    # 4. Between them quadratic polynomials: of the columns, and of the rows.
    for axis in range(2):
        for i in range(3):
            nodes[axis, i] = quadratic(nodes[axis, i, 0], nodes[axis, i, 1], nodes[axis, i, 2], half)
        for j in range(3):
            powers[axis, :, j] = quadratic(nodes[axis, 0, j], nodes[axis, 1, j], nodes[axis, 2, j], half)


@inner
def quadratic(a: float, b: float, c: float, half: int) -> Vector:
    """Return the polynomial that is a, b and c at -half, 0 and half."""
    return b, (c - a) / (2 * half), ((a + c) / 2 - b) / half**2


@inner
def reach_of(powers: Array, half: int) -> float:
    """Return the most that a polynomial (3, 3) is within half of the middle."""
    most = 0.0
    for i in range(3):
        for j in range(3):
            most += abs(powers[i, j]) * float(half) ** (i + j)
    return most


@inner
def write_keys(places: Floats, weights: Floats) -> None:
    """Write the weights (4, N) of four pixels, between the second and third of which a place lies.

    Cubic convolution (Keys 1981, a = -1/2). Without branches, so that several are computed at once.
    """
    one, half, square, cube = np.float32(1), np.float32(0.5), np.float32(2.5), np.float32(1.5)
    for k in range(len(places)):
        u = places[k] - np.float32(np.int32(places[k]))
        p = one - u
        weights[0, k], weights[3, k] = -half * u * p * p, -half * p * u * u
        weights[1, k], weights[2, k] = one + u * u * (cube * u - square), one + p * p * (cube * p - square)


@inner
def within(index: int, size: int) -> int:
    """Return the nearest index in [0, size)."""
    return min(max(index, 0), size - 1)


@compiled(
    "(f4[:, :, ::1], u1[:, ::1], f8[:, ::1], f8, i8, f8, f8[:, ::1], f8[:, ::1], f8[:, :, ::1], b1[::1])",
    writes=("shift", "slopes", "covariance", "fits"),
)
def fit(
    templates: Floats,
    image: Image,
    centres: Array,
    noise_grey: float,
    reach_px: int,
    slope_sigma: float,
    shift: Array,
    slopes: Array,
    covariance: Array,
    fits: Flags,
) -> None:
    """Fit shift (N, 2), change of the slopes (N, 2) and gain of templates (N, S + 2, S + 2) to windows of an image.

    centres (N, 2): pixels of the image at which the templates' middles are predicted. slopes: their prior on entry,
    with slope_sigma; 0: they do not change. covariance (N, 2, 2) [px^2] of the shift; fits (N,): textured, and moved by
    less than reach_px.
    """
    side, size = templates.shape[1] - 2, 5 if slope_sigma > 0 else 3
    pixels, noise = side * side, 2 * max(noise_grey, 1.0) ** 2
    design, ones = np.empty((size, side, side), np.float32), np.ones((side, side), np.float32)
    window, room = np.empty((side, side), np.float32), np.empty(side, np.float32)
    cell = np.empty((side + 2 * reach_px + 1, side + 2 * reach_px + 1), np.float32)
    normal, inverse, sums = np.empty((size, size)), np.empty((size, size)), np.empty(size)
    right, weighted, solution = np.empty(size), np.empty(size), np.empty(size)
    for n in range(len(templates)):
        fits[n], shift[n], covariance[n] = False, 0.0, 0.0
        # 1. Templates with texture: sums and products of the design, about its means.
        write_design(templates[n], design)
        for a in range(size):
            sums[a] = dot(design[a], ones, room)
            for b in range(a + 1):
                normal[a, b] = normal[b, a] = dot(design[a], design[b], room) - sums[a] * sums[b] / pixels
        trace, determinant = normal[0, 0] + normal[1, 1], normal[0, 0] * normal[1, 1] - normal[0, 1] ** 2
        if normal[2, 2] <= pixels * MIN_CONTRAST**2 or determinant <= MIN_DETERMINANT * trace**2:
            continue
        reach = side // 2 + reach_px
        left, top = math.floor(centres[n, 0] + 0.5) - reach, math.floor(centres[n, 1] + 0.5) - reach
        copy_cell(image, left, top, side + 2 * reach_px + 1, side + 2 * reach_px + 1, cell)
        x, y, gain, variance, residual = 0.0, 0.0, 1.0, noise, 0.0
        for _ in range(ITERATIONS):
            # 2. The window at the shift, and its products with the design and with itself.
            write_window(cell, x + reach_px, y + reach_px, window)
            total = dot(window, ones, room)
            residual = dot(window, window, room) - total * total / pixels
            # 3. The step, with the prior of the slopes.
            for a in range(size):
                weighted[a] = right[a] = dot(design[a], window, room) - sums[a] * total / pixels
                for b in range(size):
                    inverse[a, b] = normal[a, b]
            for a in range(3, size):
                prior = NOISE_CORRELATION * variance / (gain * slope_sigma) ** 2
                inverse[a, a] += prior
                weighted[a] += prior * gain * slopes[n, a - 3]
            invert(inverse)
            for a in range(size):
                solution[a] = 0.0
                for b in range(size):
                    solution[a] += inverse[a, b] * weighted[b]
            for a in range(size):
                residual -= 2 * right[a] * solution[a]
                for b in range(size):
                    residual += solution[a] * normal[a, b] * solution[b]
            gain = min(max(solution[2], 1 / LARGEST_GAIN), LARGEST_GAIN)
            variance = max(residual / pixels, noise)
            step_x, step_y = solution[0] / gain, solution[1] / gain
            x, y = x + min(max(step_x, -1.0), 1.0), y + min(max(step_y, -1.0), 1.0)
            if not (abs(x) < reach_px and abs(y) < reach_px) or max(abs(step_x), abs(step_y)) <= CONVERGED_PX:
                break
        # 4. The result.
        fits[n] = abs(x) < reach_px and abs(y) < reach_px and 1 / LARGEST_GAIN < solution[2] < LARGEST_GAIN
        shift[n, 0], shift[n, 1] = x, y
        for a in range(3, size):
            slopes[n, a - 3] = solution[a] / gain
        write_covariance(inverse, max(residual, 0.0) / (pixels - 4) / gain**2, pixels, covariance[n])


@inner
def write_design(template: Floats, design: Floats) -> None:
    """Write the design (3 or 5, S, S) of a template (S + 2, S + 2): minus its derivatives, and the window itself.

    The gradients along column and row are by Scharr's 3x3 operator; a slope moves a pixel by its column or row from
    the middle.
    """
    size, side = design.shape[0], design.shape[1]
    for i in range(side):
        above, here, below = template[i], template[i + 1], template[i + 2]
        for j in range(side):
            left, right = 3 * (above[j] + below[j]) + 10 * here[j], 3 * (above[j + 2] + below[j + 2]) + 10 * here[j + 2]
            up = 3 * (above[j] + above[j + 2]) + 10 * above[j + 1]
            down = 3 * (below[j] + below[j + 2]) + 10 * below[j + 1]
            design[0, i, j], design[1, i, j] = (left - right) / 32, (up - down) / 32
            design[2, i, j] = here[j + 1]
    for a in range(3, size):
        for i in range(side):
            for j in range(side):
                design[a, i, j] = design[1, i, j] * ((j if a == 3 else i) - side // 2)


@inner
def copy_cell(image: Image, left: int, top: int, width: int, height: int, cell: Floats) -> None:
    """Write pixels of an image, less the middle grey, into a cell (S, W); the border is repeated."""
    for i in range(height):
        line, to = image[within(top + i, image.shape[0])], cell[i]
        if left >= 0 and left + width <= image.shape[1]:
            source = line[left:]
            for j in range(width):
                to[j] = np.float32(source[j]) - MIDDLE_GREY
        else:
            for j in range(width):
                to[j] = np.float32(line[within(left + j, image.shape[1])]) - MIDDLE_GREY


@inner
def write_window(cell: Floats, x: float, y: float, window: Floats) -> None:
    """Write the window (S, S) that begins between the pixels of a cell, by bilinear interpolation."""
    left, top = math.floor(x), math.floor(y)
    u, v = np.float32(x - left), np.float32(y - top)
    p, q = np.float32(1) - u, np.float32(1) - v
    for i in range(window.shape[0]):
        above, below, to = cell[top + i, left:], cell[top + i + 1, left:], window[i]
        for j in range(window.shape[0]):
            to[j] = q * (p * above[j] + u * above[j + 1]) + v * (p * below[j] + u * below[j + 1])


@inner
def dot(a: Floats, b: Floats, room: Floats) -> float:
    """Return the sum of the products of two windows (S, S); by column (S,), which are added several at once."""
    room[:] = 0.0
    for i in range(a.shape[0]):
        one, other = a[i], b[i]
        for j in range(len(room)):
            room[j] += one[j] * other[j]
    total = 0.0
    for j in range(len(room)):
        total += room[j]
    return total


@inner
def invert(H: Array) -> None:
    """Replace a positive definite matrix (M, M) by its inverse, by sweeps (Goodnight 1979)."""
    size = len(H)
    for k in range(size):
        pivot = 1 / H[k, k]
        for a in range(size):
            for b in range(size):
                if a != k and b != k:
                    H[a, b] -= H[a, k] * H[k, b] * pivot
        for a in range(size):
            if a != k:
                H[a, k], H[k, a] = -H[a, k] * pivot, H[k, a] * pivot
        H[k, k] = pivot


@inner
def write_covariance(inverse: Array, variance: float, pixels: int, covariance: Array) -> None:
    """Write the covariance (2, 2) [px^2] of a shift from the variance of the residuals in units of the template."""
    # Noise in the template is taken for texture: its part of the gradients' matrix is taken off.
    determinant = inverse[0, 0] * inverse[1, 1] - inverse[0, 1] * inverse[1, 0]
    trace = (inverse[0, 0] + inverse[1, 1]) / max(determinant, 1e-12)
    texture = min(max(1 - GRADIENT_NOISE * pixels * variance / max(trace, 1e-9), MIN_TRUE_GRADIENT), 1.0)
    for a in range(2):
        for b in range(2):
            covariance[a, b] = NOISE_CORRELATION * variance / texture * inverse[a, b]


@compiled("(u1[:, ::1], u1[:, ::1], f8[:, :], f8[:, :, :], i8, f8[:, ::1])", writes=("found",))
def correlate(a: Image, b: Image, at_a: Array, at_b: Array, side: int, found: Array) -> None:
    """Write the correlations (K, N) of windows of side^2 greys about places (N, 2) of an image, see `correlations`."""
    pixels, least = side**2, (side**2 * MIN_CONTRAST) ** 2
    cell, size = np.zeros((side + 1) ** 2 + 1, np.int32), side * (side + 1)
    one, other = np.empty(size, np.int32), np.empty(size, np.int32)
    for n in range(len(at_a)):
        write_greys(a, at_a[n], side, cell, one)
        for h in range(len(at_b)):
            write_greys(b, at_b[h, n], side, cell, other)
            x, y, xx, yy, xy = 0, 0, 0, 0, 0
            for k in range(size):
                x, y = x + one[k], y + other[k]
                xx, yy, xy = xx + one[k] * one[k], yy + other[k] * other[k], xy + one[k] * other[k]
            spread, spread_of_other = float(pixels * xx - x * x), float(pixels * yy - y * y)
            is_textured = min(spread, spread_of_other) > least
            found[h, n] = float(pixels * xy - x * y) / math.sqrt(spread * spread_of_other) if is_textured else 0.0


@inner
def write_greys(image: Image, at: Array, side: int, cell: Integers, greys: Integers) -> None:
    """Write the greys (side, side + 1) about a place, the last column zeros, by bilinear interpolation to 1/32 px.

    cell: room for a row and a column more. Windows lie within the columns; the first and last rows are repeated. All
    are integers and rows follow each other, so that several are computed at once.
    """
    left, top, width = math.floor(at[0]) - side // 2, math.floor(at[1]) - side // 2, side + 1
    u, v = np.int32(32 * (at[0] - math.floor(at[0])) + 0.5), np.int32(32 * (at[1] - math.floor(at[1])) + 0.5)
    left = min(max(left, 0), image.shape[1] - width)
    for i in range(width):
        line, to = image[within(top + i, len(image)), left:], cell[i * width :]
        for j in range(width):
            to[j] = line[j]
    p, q, r, s = (32 - u) * (32 - v), u * (32 - v), (32 - u) * v, u * v
    for k in range(side * width):
        greys[k] = (p * cell[k] + q * cell[k + 1] + r * cell[k + width] + s * cell[k + width + 1] + 512) >> 10
    for i in range(side):
        greys[i * width + side] = 0
