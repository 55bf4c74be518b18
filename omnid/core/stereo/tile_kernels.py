"""Compiled loops of the tiles of a panorama: sums over the pixels of each tile, and energies of columns of tiles."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from omnid.core.compiled import compiled

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
    sums[:] = 0
    for r in range(len(rows) - 1):
        for v in range(rows[r], rows[r + 1]):
            for c in range(len(columns) - 1):
                grey, square, full, change = np.int32(0), np.int32(0), np.int32(0), np.int32(0)
                for u in range(columns[c], columns[c + 1]):
                    counts, a, b = np.int32(shown[v, u]), np.int32(image[v, u]), np.int32(before[v, u])
                    grey += counts * a
                    square += counts * a * a
                    full += counts if image[v, u] >= saturated else np.int32(0)
                    change += counts * abs(a - b)
                sums[0, r, c] += grey
                sums[1, r, c] += square
                sums[2, r, c] += full
                sums[3, r, c] += change


@compiled("(u1[:, ::1], u1[:, ::1], i4[::1], f8[::1])", writes=("sums",))
def column_energies(image: Bytes, shown: Bytes, columns: Numbers, sums: Doubles) -> None:
    """Write sums (C,) of the squared gradient at half resolution over columns of tiles.

    image (2 H or 2 H + 1, 2 W or 2 W + 1); shown (H, W): 1 where a pixel of the half resolution counts, else 0;
    columns (C + 1,): first column of each column of tiles at half resolution, and the end.
    """
    height, width = shown.shape
    half, above = np.empty(width + 1, np.int32), np.empty(width + 1, np.int32)
    sums[:] = 0.0
    for v in range(height):
        for u in range(width):
            top = np.int32(image[2 * v, 2 * u]) + np.int32(image[2 * v, 2 * u + 1])
            bottom = np.int32(image[2 * v + 1, 2 * u]) + np.int32(image[2 * v + 1, 2 * u + 1])
            half[u + 1] = (top + bottom + np.int32(2)) >> 2
        # The first row and the first column have no neighbour before them.
        half[0] = half[1]
        for u in range(width + 1):
            above[u] = half[u] if v == 0 else above[u]
        for c in range(len(columns) - 1):
            energy = np.int32(0)
            for u in range(columns[c], columns[c + 1]):
                across, down = half[u + 1] - half[u], half[u + 1] - above[u + 1]
                energy += np.int32(shown[v, u]) * (across * across + down * down)
            sums[c] += energy
        for u in range(width + 1):
            above[u] = half[u]
