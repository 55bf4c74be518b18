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
# Least sine of the angle between a ray and a normal for which the ray has a direction on the surface.
SHORT = np.float32(1e-4)
# Texels across a footprint above which a smaller level is read, and below which one place across is enough.
WIDEST, NARROW = np.float32(1.6), np.float32(0.8)
MOST_STEPS = 24  # along a footprint
# Rows of a surface (4, 4): distance from its plane [m], fraction u and fraction v of a point, each by the gradient (3)
# and the value at the frame's origin; then brightness, texels per m^2, least distance from the origin of any ray, 0.
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
    n0, n1, n2, n = surface[0, 0], surface[0, 1], surface[0, 2], surface[0, -1]
    u0, u1, u2, u = surface[1, 0], surface[1, 1], surface[1, 2], surface[1, -1]
    v0, v1, v2, v = surface[2, 0], surface[2, 1], surface[2, 2], surface[2, -1]
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
def meet(
    candidates: Whole, hits: Whole, surfaces: Floats, rays: Rows, origins: Rows, nearest: Numbers, distance: Floats
) -> int:
    """Set the nearest of candidate rectangles for each ray, -1: none, and its distance; return how many were tried.

    hits: set to the number of rays that met each of these first. Candidates are sorted by their least distance: none
    can be met any more once one is farther than all rays reach.
    """
    for i in range(len(nearest)):
        nearest[i], distance[i] = -1, FAR_M
    for n in range(len(candidates)):
        k = candidates[n]
        if farther(distance, surfaces[k, -1, 2]) == 0:
            return n
        hits[n] = take_nearer(np.int32(k), surfaces[k], rays, origins, nearest, distance)
    return len(candidates)


@inner
def only_one(tried: Whole, surfaces: Floats, rays: Rows, nearest: Numbers, distance: Floats) -> int:
    """Return the one rectangle that all rays from the origin meet, with all others that were tried behind it, or -1."""
    only = int(nearest[0])
    for i in range(1, len(nearest)):
        only = only if nearest[i] == only else -1
    for n in range(len(tried)):
        if only >= 0 and tried[n] != only and not is_behind(surfaces[tried[n]], rays, distance):
            only = -1
    return only


@inner
def is_beyond(sides: Floats, axis: Floats, sine: np.float32) -> bool:
    """Return whether a cone lies wholly beyond one of the four sides of a pyramid."""
    outside = 0
    for n in range(4):
        outside += axis[0] * sides[n, 0] + axis[1] * sides[n, 1] + axis[2] * sides[n, 2] < -sine
    return outside > 0


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
    n0, n1, n2, density = surface[0, 0], surface[0, 1], surface[0, 2], surface[-1, 1]
    u0, u1, u2, u = surface[1, 0], surface[1, 1], surface[1, 2], surface[1, -1]
    v0, v1, v2, v = surface[2, 0], surface[2, 1], surface[2, 2], surface[2, -1]
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
        image[pixels[i]] += surfaces[k, -1, 0] * bilinear(texels, levels[level, 0], size, (across[i], down[i]))


@inner
def is_behind(surface: Floats, rays: Rows, distance: Floats) -> bool:
    """Return whether the plane of a rectangle lies behind what rays from the origin meet, or is not met at all."""
    (x, y, z), count = rays, 0
    for i in range(len(x)):
        s = -surface[0, -1] / (surface[0, 0] * x[i] + surface[0, 1] * y[i] + surface[0, 2] * z[i])
        count += (s > ZERO) & (s < distance[i])
    return count == 0


@inner
def shade_one(
    k: int,
    surface: Floats,
    rays: Rows,
    spacing_and_distance: tuple[Floats, Floats],
    pyramids: Whole,
    levels: Whole,
    texels: NDArray[np.uint8],
    weight: np.float32,
    pixels: Numbers,
    image: Floats,
) -> None:
    """Add the grey of rays (N,) from the origin, one a pixel, that all meet one rectangle, over their footprints.

    A footprint is a square across the ray, drawn out along the ray's projection on the surface; its grey is the mean of
    places that cover it.
    """
    n0, n1, n2 = surface[0, 0], surface[0, 1], surface[0, 2]
    u0, u1, u2, v0, v1, v2 = surface[1, 0], surface[1, 1], surface[1, 2], surface[2, 0], surface[2, 1], surface[2, 2]
    (x, y, z), (spacing, distance) = rays, spacing_and_distance
    for i in range(len(x)):
        cosine = n0 * x[i] + n1 * y[i] + n2 * z[i]
        side = distance[i] * spacing[i]
        # 1. The directions of the footprint on the surface: along the ray, and across.
        ax, ay, az = x[i] - cosine * n0, y[i] - cosine * n1, z[i] - cosine * n2
        length = np.float32(np.sqrt(ax * ax + ay * ay + az * az))
        if length < SHORT:
            ax, ay, az = u0, u1, u2
            length = np.float32(np.sqrt(ax * ax + ay * ay + az * az))
        ax, ay, az = ax / length, ay / length, az / length
        bx, by, bz = n1 * az - n2 * ay, n2 * ax - n0 * az, n0 * ay - n1 * ax
        slant = ONE / max(abs(cosine), MIN_SLANT)
        # 2. The level whose texels are about as large as the square, and the places that cover the footprint there.
        level, last = pyramids[k, 0], pyramids[k, 0] + pyramids[k, 1] - 1
        texels_across = side * np.float32(np.sqrt(surface[-1, 1]))
        while texels_across > WIDEST and level < last:
            texels_across, level = texels_across * HALF, level + 1
        steps = min(int(np.ceil(texels_across * slant)), MOST_STEPS)
        ways = 2 if texels_across > NARROW else 1
        along, across = side * slant / np.float32(steps), side / np.float32(ways)
        # 3. Place, and a step along and across, as fractions of the outline.
        px, py, pz = distance[i] * x[i], distance[i] * y[i], distance[i] * z[i]
        u = surface[1, -1] + u0 * px + u1 * py + u2 * pz
        v = surface[2, -1] + v0 * px + v1 * py + v2 * pz
        ua = along * (u0 * ax + u1 * ay + u2 * az)
        va = along * (v0 * ax + v1 * ay + v2 * az)
        ub = across * (u0 * bx + u1 * by + u2 * bz)
        vb = across * (v0 * bx + v1 * by + v2 * bz)
        # 4. The mean grey.
        size, total = (levels[level, 1], levels[level, 2]), ZERO
        for n in range(steps):
            m = np.float32(n) - np.float32(steps - 1) * HALF
            for way in range(ways):
                w = np.float32(way) - np.float32(ways - 1) * HALF
                total += bilinear(texels, levels[level, 0], size, (u + m * ua + w * ub, v + m * va + w * vb))
        image[pixels[i]] += weight * surface[-1, 0] * total / np.float32(steps * ways)


@compiled(
    "(f4[:, ::1], f4[:, ::1], f4[::1], i4[:, ::1], i8[::1], f4[:, ::1], f4[::1], i4[:, ::1], i8[::1], f4[:, ::1], "
    "f4[::1], f8[:, :, ::1], i8[::1], b1[:, ::1], f4[:, :, ::1], f4[:, :, ::1], i8[:, ::1], i8[:, ::1], u1[::1], f4, "
    "f4[::1])",
    writes=("image",),
)
def cast(
    rays: Floats,
    origins: Floats,
    spacing: Floats,
    index: Numbers,
    starts: Whole,
    plain_rays: Floats,
    plain_spacing: Floats,
    plain_index: Numbers,
    plain_starts: Whole,
    axes: Floats,
    sines: Floats,
    poses: Doubles,
    parents: Whole,
    seen: NDArray[np.bool_],
    sides: Floats,
    surfaces: Floats,
    pyramids: Whole,
    levels: Whole,
    texels: NDArray[np.uint8],
    weight: np.float32,
    image: Floats,
) -> None:
    """Add the greys of N samples in M tiles to an image.

    rays (3, N), origins (3, N) [m] in the camera frame, (3, 1) where all are the same; spacing (N,) [rad]; index (2, N)
    of pixel and pose; starts (M + 1,) of the tiles. plain_...: one ray a pixel of the same tiles of a central camera at
    rest, which is cast where it shows one rectangle only, with a weight that makes up for the samples; without any all
    samples are cast. axes (M, 3) and sines (M,): the cones of these tiles. poses (H, 3, 4) of the camera in the frame
    of the first one, (1, 3, 4) where all are the same. parents (M,): row of a tile in seen (P, R), the rectangles that
    larger tiles may see; sides (R, 4, 3): normals, to the inside, of the planes through the origin and an edge.
    surfaces (R, 4, 4), in that frame, by their least distance. pyramids (R, 2): first level, number of
    levels; levels (L, 3): first texel, height, width.
    """
    tiles, surface_count, has_plain = len(starts) - 1, len(surfaces), len(plain_starts) > 1
    largest = 0
    for tile in range(tiles):
        largest = max(largest, starts[tile + 1] - starts[tile])
    moving = len(poses) > 1 or origins.shape[1] > 1
    turned, moved = np.empty((3, largest), np.float32), np.zeros((3, largest), np.float32)
    nearest, distance = np.empty(largest, np.int32), np.empty(largest, np.float32)
    places = np.empty((3, largest), np.float32)
    candidates, hits = np.empty(surface_count, np.int64), np.empty(surface_count, np.int64)
    for tile in range(tiles):
        low, high = starts[tile], starts[tile + 1]
        count = high - low
        if not count:
            continue
        # 1. The rectangles that the tile may see.
        number = 0
        for k in range(surface_count):
            if seen[parents[tile], k] and not (has_plain and is_beyond(sides[k], axes[tile], sines[tile])):
                candidates[number] = k
                number += 1
        # 2. Is it one only?
        if has_plain:
            first, last = plain_starts[tile], plain_starts[tile + 1]
            plain = last - first
            if not plain:
                continue
            ray = plain_rays[0, first:last], plain_rays[1, first:last], plain_rays[2, first:last]
            origin = moved[0, :plain], moved[1, :plain], moved[2, :plain]
            near, far = nearest[:plain], distance[:plain]
            tried = meet(candidates[:number], hits, surfaces, ray, origin, near, far)
            only = only_one(candidates[:tried], surfaces, ray, near, far)
            if only >= 0:
                part, pixels = (plain_spacing[first:last], far), plain_index[0, first:last]
                shade_one(only, surfaces[only], ray, part, pyramids, levels, texels, weight, pixels, image)
                continue
        # 3. The rays in the frame of the first pose.
        ray = rays[0, low:high], rays[1, low:high], rays[2, low:high]
        origin = moved[0, :count], moved[1, :count], moved[2, :count]
        if moving:
            begin = origins[:, low:high] if origins.shape[1] > 1 else origins
            turn(poses, index[1, low:high], rays[:, low:high], begin, turned, moved)
            ray = turned[0, :count], turned[1, :count], turned[2, :count]
        # 4. The nearest rectangle of each ray, the place on it, and its grey there.
        near, far = nearest[:count], distance[:count]
        tried = meet(candidates[:number], hits, surfaces, ray, origin, near, far)
        place = places[0, :count], places[1, :count], places[2, :count]
        for n in range(tried):
            if hits[n]:
                k = candidates[n]
                place_on(np.int32(k), surfaces[k], ray, origin, spacing[low:high], near, far, place)
        shade(near, place, surfaces, pyramids, levels, texels, index[0, low:high], image)
