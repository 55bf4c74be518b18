"""Compiled loops of the ray caster: for every sample the nearest rectangle, and the grey of its texture there.

The rays of a tile are tried against one rectangle after the other, in loops without branches that the compiler turns
into vector instructions. The rows of a surface (4, 4) are: distance from its plane [m], fraction u and fraction v of a
point, each by the gradient (3) and the value at the frame's origin; then brightness, texels per m^2, least distance
from the origin of any ray, 0.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from omnid.core.compiled import compiled, inner

Floats = NDArray[np.float32]
Whole = NDArray[np.int64]
Numbers = NDArray[np.int32]
Rows = tuple[Floats, Floats, Floats]  # x, y, z (N,), each contiguous: loops over columns become vector instructions
MIN_SLANT = np.float32(0.02)  # Least cosine between a ray and a rectangle's normal in a sample's footprint.
ZERO, HALF, ONE, FAR_M = np.float32(0.0), np.float32(0.5), np.float32(1.0), np.float32(np.inf)
# Fractions u, v of a rectangle: it reaches beyond its outline by the rounding, so that no ray passes between two walls.
LOW_EDGE, HIGH_EDGE = np.float32(-2e-6), np.float32(1.0 + 2e-6)
# Texels of a sample's footprint above which a smaller level of the texture is read, and of one at the next level.
FOOTPRINT, QUARTER = np.float32(2.0), np.float32(0.25)


@inner
def bilinear(texels: NDArray[np.uint8], first: int, size: tuple[int, int], u: np.float32, v: np.float32) -> np.float32:
    """Return the texture of a size (height, width) at fractions u, v of its outline; its border is repeated."""
    height, width = size
    x = min(max(u * np.float32(width) - HALF, ZERO), np.float32(width - 1))
    y = min(max(v * np.float32(height) - HALF, ZERO), np.float32(height - 1))
    column, line = min(int(x), max(width - 2, 0)), min(int(y), max(height - 2, 0))
    right, below = min(1, width - 1), min(1, height - 1) * width
    x, y, at = x - np.float32(column), y - np.float32(line), first + line * width + column
    top = np.float32(texels[at]) * (ONE - x) + np.float32(texels[at + right]) * x
    bottom = np.float32(texels[at + below]) * (ONE - x) + np.float32(texels[at + below + right]) * x
    return np.float32(top * (ONE - y) + bottom * y)


@inner
def take_nearer(
    number: np.int32, surface: Floats, rays: Rows, origins: Rows, nearest: Numbers, distance: Floats
) -> None:
    """Note a rectangle where it is the nearest one so far: distance (N,) [m] along the rays."""
    n0, n1, n2, n = surface[0, 0], surface[0, 1], surface[0, 2], surface[0, -1]
    u0, u1, u2, u = surface[1, 0], surface[1, 1], surface[1, 2], surface[1, -1]
    v0, v1, v2, v = surface[2, 0], surface[2, 1], surface[2, 2], surface[2, -1]
    (x, y, z), (a, b, c) = rays, origins
    for i in range(len(x)):
        s = -(n + n0 * a[i] + n1 * b[i] + n2 * c[i]) / (n0 * x[i] + n1 * y[i] + n2 * z[i])
        px, py, pz = a[i] + s * x[i], b[i] + s * y[i], c[i] + s * z[i]
        across = u + u0 * px + u1 * py + u2 * pz
        down = v + v0 * px + v1 * py + v2 * pz
        inside = (across >= LOW_EDGE) & (across <= HIGH_EDGE) & (down >= LOW_EDGE) & (down <= HIGH_EDGE)
        is_hit = (s > ZERO) & (s < distance[i]) & inside
        distance[i] = s if is_hit else distance[i]
        nearest[i] = number if is_hit else nearest[i]


@inner
def meet(seen: NDArray[np.bool_], surfaces: Floats, rays: Rows, origins: Rows, nearest: Numbers, far: Floats) -> None:
    """Set the nearest of the seen (R,) rectangles for each ray, -1: none, and its distance.

    Rectangles are sorted by their least distance: none can be met any more once one is farther than all rays reach.
    """
    for i in range(len(nearest)):
        nearest[i], far[i] = -1, FAR_M
    for k in range(len(seen)):
        if seen[k]:
            farther = 0
            for i in range(len(far)):
                farther += far[i] > surfaces[k, -1, 2]
            if farther == 0:
                return
            take_nearer(np.int32(k), surfaces[k], rays, origins, nearest, far)


@inner
def shade(
    surfaces: Floats,
    rays: Rows,
    origins: Rows,
    spacing: Floats,
    nearest: Numbers,
    distance: Floats,
    textures: tuple[Whole, Whole, NDArray[np.uint8]],
    pixels: Numbers,
    image: Floats,
) -> None:
    """Add the greys of rays (N,) to their pixels; textures: pyramids, levels, texels, see `cast`."""
    (x, y, z), (a, b, c), (pyramids, levels, texels) = rays, origins, textures
    for i in range(len(nearest)):
        k = nearest[i]
        if k < 0:
            continue
        # 1. The place on the rectangle, and the footprint of the sample there [texels].
        to_plane, across, down, s = surfaces[k, 0], surfaces[k, 1], surfaces[k, 2], distance[i]
        px, py, pz = a[i] + s * x[i], b[i] + s * y[i], c[i] + s * z[i]
        slant = max(abs(to_plane[0] * x[i] + to_plane[1] * y[i] + to_plane[2] * z[i]), MIN_SLANT)
        u = across[3] + across[0] * px + across[1] * py + across[2] * pz
        v = down[3] + down[0] * px + down[1] * py + down[2] * pz
        footprint = s * s * spacing[i] * spacing[i] / slant * surfaces[k, -1, 1]
        # 2. The level whose texels are about as large: half of the footprint's logarithm to base 2, rounded.
        level, last = pyramids[k, 0], pyramids[k, 0] + pyramids[k, 1] - 1
        while footprint > FOOTPRINT and level < last:
            footprint, level = footprint * QUARTER, level + 1
        size = (levels[level, 1], levels[level, 2])
        image[pixels[i]] += surfaces[k, -1, 0] * bilinear(texels, levels[level, 0], size, u, v)


@compiled(
    "(f4[:, ::1], f4[:, ::1], f4[::1], i4[::1], i8[::1], b1[:, ::1], f4[:, :, ::1], i8[:, ::1], i8[:, ::1], "
    "u1[::1], f4[::1])",
    writes=("image",),
)
def cast(
    rays: Floats,
    origins: Floats,
    spacing: Floats,
    pixels: Numbers,
    starts: Whole,
    seen: NDArray[np.bool_],
    surfaces: Floats,
    pyramids: Whole,
    levels: Whole,
    texels: NDArray[np.uint8],
    image: Floats,
) -> None:
    """Add the greys of N samples in M tiles to an image.

    rays (3, N), origins (3, N) [m] in the camera frame; those that all tiles share have as many columns as the largest
    one. spacing (N,) [rad]; pixels (N,); starts (M + 1,) of the tiles. seen (M, R): the rectangles that a tile may see.
    surfaces (R, 4, 4), in the camera frame, by their least distance. pyramids (R, 2): first level, number of levels;
    levels (L, 3): first texel, height, width.
    """
    tiles = len(starts) - 1
    largest = 0
    for tile in range(tiles):
        largest = max(largest, starts[tile + 1] - starts[tile])
    nearest, distance = np.empty(largest, np.int32), np.empty(largest, np.float32)
    for tile in range(tiles):
        # 1. The rays of the tile.
        low, high = starts[tile], starts[tile + 1]
        count = high - low
        first = low if origins.shape[1] == len(spacing) else 0
        ray = rays[0, low:high], rays[1, low:high], rays[2, low:high]
        last = first + count
        origin = origins[0, first:last], origins[1, first:last], origins[2, first:last]
        # 2. The nearest rectangle of each ray, and its grey there.
        near, far, textures = nearest[:count], distance[:count], (pyramids, levels, texels)
        meet(seen[tile], surfaces, ray, origin, near, far)
        shade(surfaces, ray, origin, spacing[low:high], near, far, textures, pixels[low:high], image)
