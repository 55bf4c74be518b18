"""Compiled loops of the ray caster: for every sample the nearest rectangle, and the grey of its texture there."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from omnid.core.compiled import compiled, inner

Floats = NDArray[np.float32]
Doubles = NDArray[np.float64]
Whole = NDArray[np.int64]
# Least cosine between a ray and a rectangle's normal in a sample's footprint.
MIN_SLANT = 0.02
# Columns of a surface: origin (3), coordinates u and v (3 each) per metre, unit normal (3), brightness, texels per m^2.
SURFACE_COLUMNS = 14


@inner
def bilinear(texels: NDArray[np.uint8], first: int, size: tuple[int, int], place: tuple[float, float]) -> float:
    """Return the texture of a size (height, width) at fractions u, v of its outline; its border is repeated."""
    height, width = size
    x = min(max(place[0] * width - 0.5, 0.0), width - 1.0)
    y = min(max(place[1] * height - 0.5, 0.0), height - 1.0)
    column, line = min(int(x), max(width - 2, 0)), min(int(y), max(height - 2, 0))
    right, below = min(1, width - 1), min(1, height - 1) * width
    x, y, at = x - column, y - line, first + line * width + column
    top = texels[at] * (1.0 - x) + texels[at + right] * x
    bottom = texels[at + below] * (1.0 - x) + texels[at + below + right] * x
    return float(top * (1.0 - y) + bottom * y)


@inner
def nearest_hit(ray: tuple[float, float, float, float, float, float], seen: NDArray[np.int64], count: int,
                surfaces: Doubles, least_m: Doubles) -> tuple[int, float, float, float]:
    """Return number, distance [m] and fractions u, v of the nearest rectangle of a ray (origin, direction); -1: none.

    seen: the numbers of the rectangles to try, sorted by the least distance at which any ray meets them.
    """
    ox, oy, oz, dx, dy, dz = ray
    best, best_m, best_u, best_v = -1, np.inf, 0.0, 0.0
    for i in range(count):
        k = seen[i]
        if least_m[k] > best_m:
            break
        surface = surfaces[k]
        along = surface[9] * dx + surface[10] * dy + surface[11] * dz
        wx, wy, wz = ox - surface[0], oy - surface[1], oz - surface[2]
        s = -(surface[9] * wx + surface[10] * wy + surface[11] * wz) / along
        if not 0.0 < s < best_m:
            continue
        wx, wy, wz = wx + s * dx, wy + s * dy, wz + s * dz
        u = surface[3] * wx + surface[4] * wy + surface[5] * wz
        if not 0.0 <= u <= 1.0:
            continue
        v = surface[6] * wx + surface[7] * wy + surface[8] * wz
        if 0.0 <= v <= 1.0:
            best, best_m, best_u, best_v = k, s, u, v
    return best, best_m, best_u, best_v


@compiled("(f4[:, ::1], f4[:, ::1], f4[::1], i8[:, ::1], i8[::1], f8[:, :, ::1], b1[:, ::1], f8[:, ::1], f8[::1], "
          "i8[:, ::1], i8[:, ::1], u1[::1], f4[::1])", writes=("image",))
def cast(rays: Floats, origins: Floats, spacing: Floats, index: Whole, starts: Whole, poses: Doubles,
         seen: NDArray[np.bool_], surfaces: Doubles, least_m: Doubles, pyramids: Whole, levels: Whole,
         texels: NDArray[np.uint8], image: Floats) -> None:
    """Add the grey of N samples in M tiles to an image.

    rays (N, 3), origins (N, 3) [m] in the camera frame, (1, 3) where all are the same; spacing (N,) [rad]; index (N, 2)
    of pixel and pose; starts (M + 1,) of the tiles; poses (H, 3, 4) T_world_cam, (1, 3, 4) where all are the same;
    seen (M, R): tile may see rectangle.
    surfaces (R, SURFACE_COLUMNS), sorted by least_m (R,) [m]. pyramids (R, 2): first level, number of levels; levels
    (L, 3): first texel, height, width.
    """
    numbers = np.empty(len(surfaces), np.int64)
    for tile in range(len(starts) - 1):
        count = 0
        for k in range(len(surfaces)):
            if seen[tile, k]:
                numbers[count] = k
                count += 1
        for i in range(starts[tile], starts[tile + 1]):
            T = poses[index[i, 1] if len(poses) > 1 else 0]
            x, y, z = rays[i]
            a, b, c = origins[i if len(origins) > 1 else 0]
            dx = T[0, 0] * x + T[0, 1] * y + T[0, 2] * z
            dy = T[1, 0] * x + T[1, 1] * y + T[1, 2] * z
            dz = T[2, 0] * x + T[2, 1] * y + T[2, 2] * z
            ox = T[0, 0] * a + T[0, 1] * b + T[0, 2] * c + T[0, 3]
            oy = T[1, 0] * a + T[1, 1] * b + T[1, 2] * c + T[1, 3]
            oz = T[2, 0] * a + T[2, 1] * b + T[2, 2] * c + T[2, 3]
            k, s, u, v = nearest_hit((ox, oy, oz, dx, dy, dz), numbers, count, surfaces, least_m)
            if k < 0:
                continue
            surface = surfaces[k]
            slant = max(abs(surface[9] * dx + surface[10] * dy + surface[11] * dz), MIN_SLANT)
            footprint = (s * spacing[i]) ** 2 / slant * surface[13]
            # The level whose texels are about as large as the footprint: half of its logarithm to base 2, rounded.
            level, last = pyramids[k, 0], pyramids[k, 0] + pyramids[k, 1] - 1
            while footprint > 2.0 and level < last:
                footprint, level = footprint * 0.25, level + 1
            grey = bilinear(texels, levels[level, 0], (levels[level, 1], levels[level, 2]), (u, v))
            image[index[i, 0]] += surface[12] * grey
