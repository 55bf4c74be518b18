"""Compiled part of the descriptors of corners: see features.py for their definition."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from omnid.core.compiled import compiled, inner

Floats = NDArray[np.float32]

SAMPLES = 16  # along a side of a patch, as in SIFT (Lowe 2004)
CELLS, BINS = 4, 8  # cells along a side, and directions of the gradient in each cell, as in SIFT (Lowe 2004)
LARGEST = np.float32(0.2)  # Limit of a histogram's entries, of one of length 1 (Lowe 2004).
SCALE = np.float32(512.0)  # Factor on the square roots of a descriptor's shares, so that they fill a byte.
LEAST_LENGTH = np.float32(1e-3)  # grey levels: guards against division by zero where a patch has no contrast
BINS_PER_RAD = np.float32(BINS / (2 * np.pi))  # exact: the directions make a full turn
# Polynomial of the arc tangent of 0 to 1, with an error of 1e-5 rad (4.4.49 of Abramowitz and Stegun 1964).
ATAN = (
    np.float32(0.9998660),
    np.float32(-0.3302995),
    np.float32(0.1801410),
    np.float32(-0.0851330),
    np.float32(0.0208351),
)
QUARTER, HALF, FULL = np.float32(BINS / 4), np.float32(BINS / 2), np.float32(BINS)  # turns, in directions: exact
ZERO, TINY = np.float32(0), np.float32(1e-20)  # guards against division by zero


@compiled("(f4[:, :, ::1], f4[:, ::1], u1[:, ::1])", writes=("descriptors",))
def describe(patches: Floats, weights: Floats, descriptors: NDArray[np.uint8]) -> None:
    """Write descriptors (N, CELLS^2 BINS) of patches (N, SAMPLES + 2, SAMPLES + 2).

    weights (CELLS, SAMPLES): of the samples of a row or column in each cell.
    """
    length, direction = np.empty(SAMPLES, np.float32), np.empty(SAMPLES, np.float32)
    of_row, found = np.empty((CELLS, BINS), np.float32), np.empty(CELLS * CELLS * BINS, np.float32)
    for n in range(len(patches)):
        for k in range(len(found)):
            found[k] = ZERO
        for row in range(SAMPLES):
            write_gradients(patches[n, row : row + 3], length, direction)
            write_row(length, direction, weights, of_row)
            for down in range(CELLS):
                weight = weights[down, row]
                if weight > 0:
                    for cell in range(CELLS):
                        for k in range(BINS):
                            found[(down * CELLS + cell) * BINS + k] += weight * of_row[cell, k]
        write_bytes(found, descriptors[n])


@inner
def write_gradients(rows: Floats, length: Floats, direction: Floats) -> None:
    """Write the lengths of the gradients of the middle one of three rows, and their directions, 0 to BINS."""
    for column in range(SAMPLES):
        dx, dy = rows[1, column + 2] - rows[1, column], rows[2, column + 1] - rows[0, column + 1]
        length[column] = np.sqrt(dx * dx + dy * dy)
        r = min(abs(dx), abs(dy)) / (max(abs(dx), abs(dy)) + TINY)
        s = r * r
        angle = r * (ATAN[0] + s * (ATAN[1] + s * (ATAN[2] + s * (ATAN[3] + s * ATAN[4])))) * BINS_PER_RAD
        angle = QUARTER - angle if abs(dy) > abs(dx) else angle
        angle = HALF - angle if dx < 0 else angle
        direction[column] = FULL - angle if dy < 0 else angle


@inner
def write_row(length: Floats, direction: Floats, weights: Floats, of_row: Floats) -> None:
    """Write the histograms (CELLS, BINS) of a row of samples."""
    for cell in range(CELLS):
        for k in range(BINS):
            of_row[cell, k] = ZERO
    for column in range(SAMPLES):
        # A gradient counts in the two directions next to its own, and in the cells around it.
        low = int(direction[column])
        share = direction[column] - np.float32(low)
        first, second = length[column] * (np.float32(1) - share), length[column] * share
        for cell in range(CELLS):
            weight = weights[cell, column]
            if weight > 0:
                of_row[cell, low % BINS] += weight * first
                of_row[cell, (low + 1) % BINS] += weight * second


@inner
def write_bytes(histogram: Floats, descriptor: NDArray[np.uint8]) -> None:
    """Write the square roots of the shares of a histogram, which is changed."""
    squared, total = np.float32(0), np.float32(0)
    for k in range(len(histogram)):
        squared += histogram[k] * histogram[k]
    norm = max(np.sqrt(squared), LEAST_LENGTH)
    for k in range(len(histogram)):
        histogram[k] = min(histogram[k] / norm, LARGEST)
        total += histogram[k]
    total = max(total, LEAST_LENGTH)
    for k in range(len(histogram)):
        descriptor[k] = min(np.rint(SCALE * np.sqrt(histogram[k] / total)), np.float32(255))
