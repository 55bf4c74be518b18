"""Compiled loops of the tiles of a panorama: sums over the pixels of each tile, and energies of columns of tiles."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from omnid.core.compiled import compiled, inner

Bytes = NDArray[np.uint8]
Numbers = NDArray[np.int32]
Doubles = NDArray[np.float64]


@compiled("(u1[:, ::1], u1[:, ::1], u1[:, ::1], i4[::1], i4[::1], u1, i4[:, :, ::1])", writes=("sums",))
def tile_sums(
    image: Bytes, before: Bytes, shown: Bytes, rows: Numbers, columns: Numbers, saturated: np.uint8, sums: Numbers
) -> None:
    """Write sums (4, R, C) over the shown pixels of tiles: grey, its square, saturated pixels, change since before.

    image, before, shown (H, W): shown is 1 where a pixel counts, else 0; rows (R + 1,), columns (C + 1,): first row and
    column of each tile, and the end; saturated: least grey level of a saturated pixel.
    """
    # By columns of pixels first: these are whole lines, in which the compiler adds several pixels at once.
    width = image.shape[1]
    grey, square = np.empty(width, np.int32), np.empty(width, np.int32)
    full, change = np.empty(width, np.int32), np.empty(width, np.int32)
    for r in range(len(rows) - 1):
        for u in range(width):
            grey[u] = square[u] = full[u] = change[u] = 0
        for v in range(rows[r], rows[r + 1]):
            add_greys(image[v], shown[v], grey, square)
            add_changes(image[v], before[v], shown[v], saturated, full, change)
        for c in range(len(columns) - 1):
            for k in range(4):
                sums[k, r, c] = 0
            for u in range(columns[c], columns[c + 1]):
                sums[0, r, c] += grey[u]
                sums[1, r, c] += square[u]
                sums[2, r, c] += full[u]
                sums[3, r, c] += change[u]


@inner
def add_greys(image: Bytes, shown: Bytes, grey: Numbers, square: Numbers) -> None:
    """Add the greys of the shown pixels of a line, and their squares (W,)."""
    for u in range(len(image)):
        counted = np.int32(shown[u]) * np.int32(image[u])
        grey[u] += counted
        square[u] += counted * np.int32(image[u])


@inner
def add_changes(image: Bytes, before: Bytes, shown: Bytes, saturated: np.uint8, full: Numbers, change: Numbers) -> None:
    """Add 1 for each saturated one of the shown pixels of a line, and the changes since before (W,)."""
    for u in range(len(image)):
        counts = np.int32(shown[u])
        full[u] += counts if image[u] >= saturated else np.int32(0)
        change[u] += counts * abs(np.int32(image[u]) - np.int32(before[u]))


@compiled("(u1[:, ::1], u1[:, ::1], i4[::1], f8[::1])", writes=("sums",))
def column_energies(image: Bytes, shown: Bytes, columns: Numbers, sums: Doubles) -> None:
    """Write sums (C,) of the squared gradient at half resolution over columns of tiles.

    image (2 H or 2 H + 1, 2 W or 2 W + 1); shown (H, W): 1 where a pixel of the half resolution counts, else 0;
    columns (C + 1,): first column of each column of tiles at half resolution, and the end.
    """
    height, width = shown.shape
    half, above, energy = np.empty(width + 1, np.int32), np.empty(width + 1, np.int32), np.empty(width, np.int32)
    for u in range(width):
        energy[u] = 0
    for v in range(height):
        write_half(image[2 * v], image[2 * v + 1], half)
        if v == 0:  # The first row and the first column have no neighbour before them.
            copy(half, above)
        add_energies(half, above, shown[v], energy)
        copy(half, above)
    for c in range(len(columns) - 1):
        sums[c] = 0.0
        for u in range(columns[c], columns[c + 1]):
            sums[c] += energy[u]


@inner
def write_half(top: Bytes, bottom: Bytes, half: Numbers) -> None:
    """Write a line of half the resolution from two lines (2 W or 2 W + 1,), from its second number (W + 1,) on."""
    for u in range(len(half) - 1):
        total = np.int32(top[2 * u]) + np.int32(top[2 * u + 1]) + np.int32(bottom[2 * u]) + np.int32(bottom[2 * u + 1])
        half[u + 1] = (total + np.int32(2)) >> 2
    half[0] = half[1]


@inner
def copy(line: Numbers, to: Numbers) -> None:
    """Copy a line."""
    for u in range(len(line)):
        to[u] = line[u]


@inner
def add_energies(half: Numbers, above: Numbers, shown: Bytes, energy: Numbers) -> None:
    """Add the squared gradients (W,) of a line (W + 1,) below another one, where it is shown (W,)."""
    for u in range(len(energy)):
        across, down = half[u + 1] - half[u], half[u + 1] - above[u + 1]
        energy[u] += np.int32(shown[u]) * (across * across + down * down)
