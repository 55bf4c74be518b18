"""Compiled loops of the ray caster: for every sample the nearest rectangle, and the grey of its texture there.

The rays of a tile are tried against one rectangle after the other, in loops without branches that the compiler turns
into vector instructions.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from omnid.core.compiled import compiled, inner

Floats = NDArray[np.float32]
Doubles = NDArray[np.float64]
Whole = NDArray[np.int64]
Numbers = NDArray[np.int32]
Rows = tuple[Floats, Floats, Floats]  # x, y, z (N,), each contiguous: loops over columns become vector instructions
# Least cosine between a ray and a rectangle's normal in a sample's footprint.
MIN_SLANT = np.float32(0.02)
# Columns of a surface: unit normal (3), fractions u and v per metre (3 each); distance along the normal, u and v of the
# frame's origin; brightness, texels per m^2, least distance from the origin of any ray.
SURFACE_COLUMNS = 15
ZERO, HALF, ONE, FAR_M = np.float32(0.0), np.float32(0.5), np.float32(1.0), np.float32(np.inf)
# Fractions u, v of a rectangle: it reaches beyond its outline by the rounding, so that no ray passes between two walls.
LEAST, MOST = np.float32(-2e-6), np.float32(1.0 + 2e-6)
# Texels of a sample's footprint above which a smaller level of the texture is read, and of one at the next level.
FOOTPRINT, QUARTER = np.float32(2.0), np.float32(0.25)


@inner
def bilinear(
    texels: NDArray[np.uint8], first: int, size: tuple[int, int], place: tuple[np.float32, np.float32]
) -> np.float32:
    """Return the texture of a size (height, width) at fractions u, v of its outline; its border is repeated."""
    height, width = size
    x = min(max(place[0] * np.float32(width) - HALF, ZERO), np.float32(width - 1))
    y = min(max(place[1] * np.float32(height) - HALF, ZERO), np.float32(height - 1))
    column, line = min(int(x), max(width - 2, 0)), min(int(y), max(height - 2, 0))
    right, below = min(1, width - 1), min(1, height - 1) * width
    x, y, at = x - np.float32(column), y - np.float32(line), first + line * width + column
    top = np.float32(texels[at]) * (ONE - x) + np.float32(texels[at + right]) * x
    bottom = np.float32(texels[at + below]) * (ONE - x) + np.float32(texels[at + below + right]) * x
    return np.float32(top * (ONE - y) + bottom * y)


@inner
def take_nearer(
    number: np.int32, surface: Floats, rays: Rows, origins: Rows, nearest: Numbers, distance: Floats
) -> int:
    """Note a rectangle where it is the nearest one so far: distance (N,) [m] along the rays; return for how many."""
    n0, n1, n2 = surface[0], surface[1], surface[2]
    u0, u1, u2 = surface[3], surface[4], surface[5]
    v0, v1, v2 = surface[6], surface[7], surface[8]
    n, u, v = surface[9], surface[10], surface[11]
    (x, y, z), (a, b, c) = rays, origins
    hits = 0
    for i in range(len(x)):
        s = -(n + n0 * a[i] + n1 * b[i] + n2 * c[i]) / (n0 * x[i] + n1 * y[i] + n2 * z[i])
        px, py, pz = a[i] + s * x[i], b[i] + s * y[i], c[i] + s * z[i]
        across = u + u0 * px + u1 * py + u2 * pz
        down = v + v0 * px + v1 * py + v2 * pz
        inside = (across >= LEAST) & (across <= MOST) & (down >= LEAST) & (down <= MOST)
        is_hit = (s > ZERO) & (s < distance[i]) & inside
        distance[i] = s if is_hit else distance[i]
        nearest[i] = number if is_hit else nearest[i]
        hits += is_hit
    return hits


@inner
def farther(distance: Floats, limit: np.float32) -> int:
    """Return how many distances (N,) are larger than a limit."""
    count = 0
    for i in range(len(distance)):
        count += distance[i] > limit
    return count


@inner
def place_on(
    number: np.int32,
    surface: Floats,
    rays: Rows,
    origins: Rows,
    spacing: Floats,
    nearest: Numbers,
    distance: Floats,
    places: Rows,
) -> None:
    """Set u, v and the footprint [texels] (3, N) of the rays whose nearest rectangle this is."""
    n0, n1, n2 = surface[0], surface[1], surface[2]
    u0, u1, u2 = surface[3], surface[4], surface[5]
    v0, v1, v2 = surface[6], surface[7], surface[8]
    u, v, density = surface[10], surface[11], surface[13]
    (x, y, z), (a, b, c) = rays, origins
    across, down, footprint = places
    for i in range(len(x)):
        s = distance[i]
        px, py, pz = a[i] + s * x[i], b[i] + s * y[i], c[i] + s * z[i]
        slant = max(abs(n0 * x[i] + n1 * y[i] + n2 * z[i]), MIN_SLANT)
        is_here = nearest[i] == number
        across[i] = u + u0 * px + u1 * py + u2 * pz if is_here else across[i]
        down[i] = v + v0 * px + v1 * py + v2 * pz if is_here else down[i]
        footprint[i] = s * s * spacing[i] * spacing[i] / slant * density if is_here else footprint[i]


@inner
def turn(poses: Doubles, row: Numbers, rays: Floats, origins: Floats, turned: Floats, moved: Floats) -> None:
    """Set rays and origins (3, N) in the frame of the first pose; origins (3, 1) where all are the same."""
    step = 1 if origins.shape[1] > 1 else 0
    for i in range(rays.shape[1]):
        T, x, y, z = poses[row[i] if len(poses) > 1 else 0], rays[0, i], rays[1, i], rays[2, i]
        a, b, c = origins[0, i * step], origins[1, i * step], origins[2, i * step]
        for k in range(3):
            turned[k, i] = T[k, 0] * x + T[k, 1] * y + T[k, 2] * z
            moved[k, i] = T[k, 0] * a + T[k, 1] * b + T[k, 2] * c + T[k, 3]


@inner
def shade(
    nearest: Numbers,
    places: Rows,
    surfaces: Floats,
    pyramids: Whole,
    levels: Whole,
    texels: NDArray[np.uint8],
    pixels: Numbers,
    image: Floats,
) -> None:
    """Add the greys of rays (N,) to their pixels; places: u, v and footprint [texels] on the nearest rectangle."""
    across, down, footprints = places
    for i in range(len(nearest)):
        k = nearest[i]
        if k < 0:
            continue
        # The level whose texels are about as large as the footprint: half of its logarithm to base 2, rounded.
        footprint, level, last = footprints[i], pyramids[k, 0], pyramids[k, 0] + pyramids[k, 1] - 1
        while footprint > FOOTPRINT and level < last:
            footprint, level = footprint * QUARTER, level + 1
        size = (levels[level, 1], levels[level, 2])
        image[pixels[i]] += surfaces[k, 12] * bilinear(texels, levels[level, 0], size, (across[i], down[i]))


@compiled(
    "(f4[:, ::1], f4[:, ::1], f4[::1], i4[:, ::1], i8[::1], f8[:, :, ::1], b1[:, ::1], f4[:, ::1], "
    "i8[:, ::1], i8[:, ::1], u1[::1], f4[::1])",
    writes=("image",),
)
def cast(
    rays: Floats,
    origins: Floats,
    spacing: Floats,
    index: Numbers,
    starts: Whole,
    poses: Doubles,
    seen: NDArray[np.bool_],
    surfaces: Floats,
    pyramids: Whole,
    levels: Whole,
    texels: NDArray[np.uint8],
    image: Floats,
) -> None:
    """Add the grey of N samples in M tiles to an image.

    rays (3, N), origins (3, N) [m] in the camera frame, (3, 1) where all are the same; spacing (N,) [rad]; index (2, N)
    of pixel and pose; starts (M + 1,) of the tiles; poses (H, 3, 4) of the camera in the frame of the first one,
    (1, 3, 4) where all are the same; seen (M, R): tile may see rectangle. surfaces (R, SURFACE_COLUMNS), in that frame,
    by their least distance. pyramids (R, 2): first level, number of levels; levels (L, 3): first texel, height, width.
    """
    largest = starts[0]
    for tile in range(len(starts) - 1):
        largest = max(largest, starts[tile + 1] - starts[tile])
    moving = len(poses) > 1 or origins.shape[1] > 1
    turned, moved = np.empty((3, largest), np.float32), np.empty((3, largest), np.float32)
    nearest, distance = np.empty(largest, np.int32), np.empty(largest, np.float32)
    places = np.empty((3, largest), np.float32)
    for k in range(3):
        for i in range(largest):
            moved[k, i] = ZERO
    found = np.empty(len(surfaces), np.int64)
    for tile in range(len(starts) - 1):
        low, high = starts[tile], starts[tile + 1]
        count = high - low
        # 1. The rays in the frame of the first pose.
        ray = rays[0, low:high], rays[1, low:high], rays[2, low:high]
        origin = moved[0, :count], moved[1, :count], moved[2, :count]
        if moving:
            begin = origins[:, low:high] if origins.shape[1] > 1 else origins
            turn(poses, index[1, low:high], rays[:, low:high], begin, turned, moved)
            ray = turned[0, :count], turned[1, :count], turned[2, :count]
        # 2. The nearest rectangle of each ray, and the place on it.
        for i in range(count):
            nearest[i], distance[i] = -1, FAR_M
        hit = 0
        for k in range(len(surfaces)):
            if not seen[tile, k]:
                continue
            # Rectangles are sorted by least distance: none can be met any more once it is farther than all rays reach.
            if farther(distance[:count], surfaces[k, 14]) == 0:
                break
            if take_nearer(np.int32(k), surfaces[k], ray, origin, nearest[:count], distance[:count]) > 0:
                found[hit] = k
                hit += 1
        place = places[0, :count], places[1, :count], places[2, :count]
        for n in range(hit):
            place_on(
                np.int32(found[n]),
                surfaces[found[n]],
                ray,
                origin,
                spacing[low:high],
                nearest[:count],
                distance[:count],
                place,
            )
        # 3. Its grey there.
        shade(nearest[:count], place, surfaces, pyramids, levels, texels, index[0, low:high], image)
