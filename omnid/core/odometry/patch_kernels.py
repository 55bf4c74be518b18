"""Compiled part of the fit of patches: see patch_fit.py for the equations and the meaning of the arguments."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from omnid.core.compiled import compiled, inner

Array = NDArray[np.float64]
Floats = NDArray[np.float32]
Image = NDArray[np.uint8]
Flags = NDArray[np.bool_]
Indices = NDArray[np.intp]

WINDOW_PX = 13  # Side of a patch, at most LANES.
PIXELS = WINDOW_PX * WINDOW_PX
# Enough: 98 % of the patches of test_patch_fit.py end before; a last step is below the hundredths that noise leaves.
ITERATIONS, CONVERGED_PX = 12, 0.004
# Scatter of the gains of the patches of an image, by vignetting and slanted light.
GAIN_SIGMA = 0.05
LEAST_GAIN, LARGEST_GAIN = 0.25, 4.0  # Limits; exposures were made equal before.
MIN_CONTRAST = 0.5  # grey levels, standard deviation in a window, because less is no texture
# Determinant of the gradients' matrix by its squared trace, because less is an edge, along which a patch slides.
MIN_DETERMINANT = 1e-3
# Interpolation makes the noise of neighbouring pixels alike, so that a sum over a window of a panorama varies by this
# factor more.
NOISE_CORRELATION = 3.0
# Variance of a gradient of the panorama's noise per variance of the noise, which enlarges the gradients' matrix.
GRADIENT_NOISE = 0.12
MIN_TRUE_GRADIENT = 0.2  # least share of the gradients' matrix that counts as texture.
MIDDLE_GREY = np.float32(128.0)  # Subtracted from grey levels, so that float32 loses less.
# Weights of Scharr's operator, as in OpenCV's Scharr.
SIDE_WEIGHT, INNER_WEIGHT = np.float32(3 / 32), np.float32(10 / 32)
# Columns of a row of a window in memory: a multiple of what the processor adds at once. Those beyond the window hold
# zeros in the design. Sums are kept by column until the last row, so that their order is fixed.
LANES = 16
# So many because a design has three parts, gradients along column and row and greys; a line of a template has a border
# on each side.
PART, LINE = WINDOW_PX * LANES, LANES + 2

ZERO = np.float32(0.0)
FARTHEST_PX = 1e6  # more than the columns and rows of any panorama


@compiled(
    "(u1[:, :, ::1], u1[:, :, ::1], i8[:], f8, f8[:, ::1], f8[:, :, ::1], b1[::1])",
    writes=("shift", "covariance", "fits"),
)
def fit(
    templates: Image, cells: Image, groups: Indices, noise_grey: float, shift: Array, covariance: Array, fits: Flags
) -> None:
    """Write shift (N, 2), covariance (N, 2, 2) and fits (N,) of `patch_fit.fit_patches`."""
    count, reach = len(templates), (cells.shape[1] - WINDOW_PX) // 2
    # Arrays of one axis, because within them the compiler knows what does not overlap.
    designs, lanes = np.empty((count, 3 * PART), np.float32), np.empty(9 * LANES, np.float32)
    template, cell = (
        np.empty((WINDOW_PX + 2) * LINE, np.float32),
        np.empty((cells.shape[1], cells.shape[1] + LANES + 1), np.float32),
    )
    for k in range(len(template)):
        template[k] = ZERO
    clear(cell)
    sums, normals, ratio = np.empty((count, 3)), np.empty((count, 3, 3)), np.empty(count)
    for n in range(count):
        write_design(templates[n], template, designs[n])
        write_products(designs[n], lanes, sums[n], normals[n])
        ratio[n] = np.sqrt(centred_energy(cells[n], reach) / max(normals[n, 2, 2], 1.0))
    gain = group_medians(ratio, groups)
    prior = 2 * max(noise_grey, 1.0) ** 2 / GAIN_SIGMA**2
    inverse, solution = np.empty((3, 3)), np.empty(3)
    for n in range(count):
        normal = normals[n]
        trace = normal[0, 0] + normal[1, 1]
        determinant = normal[0, 0] * normal[1, 1] - normal[0, 1] ** 2
        shift[n, 0], shift[n, 1], fits[n] = 0.0, 0.0, False
        covariance[n, 0, 0], covariance[n, 0, 1], covariance[n, 1, 0], covariance[n, 1, 1] = 0.0, 0.0, 0.0, 0.0
        if normal[2, 2] <= PIXELS * MIN_CONTRAST**2 or determinant <= MIN_DETERMINANT * trace**2:
            continue
        invert(normal, prior, inverse)
        for row in range(cells.shape[1]):
            for column in range(cells.shape[1]):
                cell[row, column] = np.float32(cells[n, row, column]) - MIDDLE_GREY
        residual = solve(designs[n], cell, lanes, reach, sums[n], normal, inverse, prior * gain[n], shift[n], solution)
        fits[n] = max(abs(shift[n, 0]), abs(shift[n, 1])) < reach and LEAST_GAIN < solution[2] < LARGEST_GAIN
        write_covariance(inverse, residual, min(max(solution[2], LEAST_GAIN), LARGEST_GAIN), covariance[n])


@compiled("(u1[:, ::1], f8[:, ::1], u1[:, :, ::1])", writes=("cells",))
def cut(image: Image, centres: Array, cells: Image) -> None:
    """Write cells (N, S, S) around whole pixels (N, 2) of an image (H, W), whose border is repeated."""
    (height, width), side = image.shape, cells.shape[1]
    for n in range(len(centres)):
        left, top = -side, -side  # a place that is NaN or absurd: the first pixel
        if abs(centres[n, 0]) < FARTHEST_PX and abs(centres[n, 1]) < FARTHEST_PX:
            left, top = int(centres[n, 0]) - side // 2, int(centres[n, 1]) - side // 2
        inside = left >= 0 and left + side <= width
        for row in range(side):
            line = image[min(max(top + row, 0), height - 1)]
            if inside:
                for column in range(side):
                    cells[n, row, column] = line[left + column]
            else:
                for column in range(side):
                    cells[n, row, column] = line[min(max(left + column, 0), width - 1)]


@inner
def clear(values: Floats) -> None:
    """Set all values (M, N) to zero."""
    for row in range(values.shape[0]):
        for column in range(values.shape[1]):
            values[row, column] = 0.0


@inner
def write_design(image: Image, template: Floats, design: Floats) -> None:
    """Write minus the gradients along column and row (Scharr's 3x3 operator), and the window, into (3 PART,).

    The window is the middle of the image (T, T). template ((WINDOW + 2) LINE,): room for it and its border.
    """
    first = image.shape[0] // 2 - WINDOW_PX // 2 - 1
    for row in range(WINDOW_PX + 2):
        for column in range(WINDOW_PX + 2):
            template[row * LINE + column] = np.float32(image[first + row, first + column]) - MIDDLE_GREY
    for row in range(WINDOW_PX):
        of_row, around = design[row * LANES :], template[row * LINE :]
        for lane in range(LANES):
            nw, n, ne = around[lane], around[lane + 1], around[lane + 2]
            w, here, e = around[lane + LINE], around[lane + (LINE + 1)], around[lane + (LINE + 2)]
            sw, s, se = around[lane + 2 * LINE], around[lane + (2 * LINE + 1)], around[lane + (2 * LINE + 2)]
            of_row[lane] = SIDE_WEIGHT * ((nw - ne) + (sw - se)) + INNER_WEIGHT * (w - e)
            of_row[lane + PART] = SIDE_WEIGHT * ((nw - sw) + (ne - se)) + INNER_WEIGHT * (n - s)
            of_row[lane + 2 * PART] = here
        for lane in range(WINDOW_PX, LANES):
            of_row[lane] = of_row[lane + PART] = of_row[lane + 2 * PART] = ZERO


@inner
def write_products(design: Floats, lanes: Floats, sums: Array, normal: Array) -> None:
    """Write the sums (3,) of the design's parts, and their products (3, 3) about the means; lanes (9 LANES,): room."""
    for k in range(9 * LANES):
        lanes[k] = ZERO
    for row in range(WINDOW_PX):
        of_row = design[row * LANES :]
        for lane in range(LANES):
            across, down, grey = of_row[lane], of_row[lane + PART], of_row[lane + 2 * PART]
            lanes[lane] += across
            lanes[lane + LANES] += down
            lanes[lane + 2 * LANES] += grey
            lanes[lane + 3 * LANES] += across * across
            lanes[lane + 4 * LANES] += across * down
            lanes[lane + 5 * LANES] += down * down
            lanes[lane + 6 * LANES] += across * grey
            lanes[lane + 7 * LANES] += down * grey
            lanes[lane + 8 * LANES] += grey * grey
    for a in range(3):
        sums[a] = total_of(lanes, a)
    product = 3
    for b in range(3):
        for a in range(b + 1):
            normal[a, b] = normal[b, a] = total_of(lanes, product) - sums[a] * sums[b] / PIXELS
            product += 1


@inner
def total_of(lanes: Floats, product: int) -> float:
    """Return the sum of all lanes of a product."""
    of_product, total = lanes[product * LANES :], 0.0
    for lane in range(LANES):
        total += of_product[lane]
    return total


@inner
def centred_energy(cell: Image, reach: int) -> float:
    """Return the sum of squares of the unshifted window about its mean."""
    total, squares = 0, 0
    for row in range(WINDOW_PX):
        for column in range(WINDOW_PX):
            grey = int(cell[reach + row, reach + column])
            total += grey
            squares += grey * grey
    return squares - total * total / PIXELS


@inner
def group_medians(ratio: Array, groups: Indices) -> Array:
    """Return for each patch (N,) the median ratio of its group, within the range of gains."""
    gain, chosen = np.empty(len(ratio)), np.empty(len(ratio))
    for n in range(len(ratio)):
        gain[n] = 0.0
    for n in range(len(ratio)):
        if gain[n] > 0:
            continue
        count = 0
        for k in range(n, len(ratio)):
            if groups[k] == groups[n]:
                chosen[count] = ratio[k]
                count += 1
        median = min(max(median_of(chosen, count), LEAST_GAIN), LARGEST_GAIN)
        for k in range(n, len(ratio)):
            if groups[k] == groups[n]:
                gain[k] = median
    return gain


@inner
def median_of(values: Array, count: int) -> float:
    """Return the median of the first values, which are sorted (Shell 1959); np.median takes two seconds to compile."""
    gap = count // 2
    while gap > 0:
        for n in range(gap, count):
            value, place = values[n], n
            while place >= gap and values[place - gap] > value:
                values[place] = values[place - gap]
                place -= gap
            values[place] = value
        gap //= 2
    middle = count // 2
    return float(values[middle] if count % 2 else (values[middle - 1] + values[middle]) / 2)


@inner
def invert(normal: Array, prior: float, inverse: Array) -> None:
    """Write the inverse (3, 3) of the normal matrix with the prior of the gain."""
    a, b, c = normal[0, 0], normal[0, 1], normal[0, 2]
    d, e, f = normal[1, 1], normal[1, 2], normal[2, 2] + prior
    m00, m01, m02 = d * f - e * e, c * e - b * f, b * e - c * d
    scale = 1 / (a * m00 + b * m01 + c * m02)
    inverse[0, 0], inverse[1, 1], inverse[2, 2] = m00 * scale, (a * f - c * c) * scale, (a * d - b * b) * scale
    inverse[0, 1] = inverse[1, 0] = m01 * scale
    inverse[0, 2] = inverse[2, 0] = m02 * scale
    inverse[1, 2] = inverse[2, 1] = (b * c - a * e) * scale


@inner
def write_window_products(design: Floats, cell: Floats, reach: int, x: float, y: float, lanes: Floats) -> None:
    """Write the products of the bilinear window at a shift x, y with the three parts of the design, with 1 and with
    itself: (5 LANES,), by column.
    """
    left, top = min(int(np.floor(x)), reach - 1), min(int(np.floor(y)), reach - 1)
    fx, fy = x - left, y - top
    nw, ne = np.float32((1 - fy) * (1 - fx)), np.float32((1 - fy) * fx)
    sw, se = np.float32(fy * (1 - fx)), np.float32(fy * fx)
    for k in range(5 * LANES):
        lanes[k] = ZERO
    for row in range(WINDOW_PX):
        of_row, above = design[row * LANES :], cell[reach + top + row, reach + left :]
        below = cell[reach + top + row + 1, reach + left :]
        for lane in range(LANES):
            grey = nw * above[lane] + ne * above[lane + 1] + sw * below[lane] + se * below[lane + 1]
            lanes[lane] += of_row[lane] * grey
            lanes[lane + LANES] += of_row[lane + PART] * grey
            lanes[lane + 2 * LANES] += of_row[lane + 2 * PART] * grey
            lanes[lane + 3 * LANES] += grey
            lanes[lane + 4 * LANES] += grey * grey


@inner
def solve(
    design: Floats,
    cell: Floats,
    lanes: Floats,
    reach: int,
    sums: Array,
    normal: Array,
    inverse: Array,
    of_gain: float,
    shift: Array,
    solution: Array,
) -> float:
    """Iterate shift (2,) and solution (3,) until they converge or leave the reach; return the mean squared residual.

    lanes (9 LANES,): room for sums.
    """
    dx, dy, p0, p1, p2, energy = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    for _ in range(ITERATIONS):
        # 1. The bilinear window at the shift, and its products with the design and with itself.
        x, y = min(max(dx, -reach), reach), min(max(dy, -reach), reach)
        write_window_products(design, cell, reach, x, y, lanes)
        total, energy = 0.0, 0.0
        for lane in range(WINDOW_PX):
            total += lanes[lane + 3 * LANES]
            energy += lanes[lane + 4 * LANES]
        mean = total / PIXELS
        energy -= total * mean
        p0, p1 = total_of(lanes, 0) - sums[0] * mean, total_of(lanes, 1) - sums[1] * mean
        p2 = total_of(lanes, 2) - sums[2] * mean
        # 2. The step.
        for a in range(3):
            solution[a] = inverse[a, 0] * p0 + inverse[a, 1] * p1 + inverse[a, 2] * (p2 + of_gain)
        scale = 1 / min(max(solution[2], LEAST_GAIN), LARGEST_GAIN)
        step_x, step_y = solution[0] * scale, solution[1] * scale
        dx += min(max(step_x, -1.0), 1.0)
        dy += min(max(step_y, -1.0), 1.0)
        if max(abs(step_x), abs(step_y)) <= CONVERGED_PX or max(abs(dx), abs(dy)) >= reach:
            break
    shift[0], shift[1] = dx, dy
    # |y - M^T s|^2 of the last step, without computing the differences.
    explained = 2 * (p0 * solution[0] + p1 * solution[1] + p2 * solution[2])
    for a in range(3):
        for b in range(3):
            explained -= solution[a] * normal[a, b] * solution[b]
    return float(max(energy - explained, 0.0) / PIXELS)


@inner
def write_covariance(inverse: Array, residual: float, gain: float, covariance: Array) -> None:
    """Write the covariance (2, 2) [px^2] of a shift from the mean squared residual and the fitted gain."""
    variance = residual * PIXELS / (PIXELS - 4) / gain**2
    # Noise in the template is taken for texture: its part of the gradients' matrix is taken off.
    determinant = inverse[0, 0] * inverse[1, 1] - inverse[0, 1] ** 2
    trace = (inverse[0, 0] + inverse[1, 1]) / max(determinant, 1e-12)
    noise = GRADIENT_NOISE * PIXELS * variance / 2
    texture = min(max(1 - 2 * noise / max(trace, 1e-9), MIN_TRUE_GRADIENT), 1.0)
    for a in range(2):
        for b in range(2):
            covariance[a, b] = NOISE_CORRELATION * variance / texture * inverse[a, b]
