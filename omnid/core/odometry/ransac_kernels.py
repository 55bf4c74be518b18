"""Compiled RANSAC on three points: see pose_estimation.py for the method and the meaning of the arguments.

camera: (focal_px, row0, columns of a turn, baseline_m, azimuth of the left edge) of the panoramas.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from omnid.core.compiled import compiled, inner
from omnid.core.odometry.view_kernels import MIN_RADIUS_M, CameraNumbers, moved

Array = NDArray[np.float64]
Flags = NDArray[np.bool_]

# Hypotheses between two tests whether the search may end, and most of those: enough for RANSAC_MISSED where 31 % of the
# landmarks are right, as (1 - 0.31^3)^480 = 5e-7.
RANSAC_BATCH, RANSAC_BATCHES = 12, 40
# Probability that no hypothesis was free of outliers, at which the search ends, so that half a day's drive misses one.
RANSAC_MISSED = 1e-6
# Constants of Marsaglia's xorshift generator with a multiplier (xorshift64*, Vigna 2016).
_MULTIPLIER = np.uint64(2685821657736338717)
_SHIFTS = np.uint64(12), np.uint64(25), np.uint64(27)
_HIGH_BITS, _UNIT = np.uint64(11), 2.0**-53  # exact: the 53 high bits are a double below 1


@compiled("(f8[:, :], f8[:, :], f8[:, :], UniTuple(f8, 5), f8, u8, f8[:, ::1], b1[::1])", writes=("best", "consensus"))
def ransac(
    landmarks: Array,
    views: Array,
    seen: Array,
    camera: CameraNumbers,
    threshold_px: float,
    seed: np.uint64,
    best: Array,
    consensus: Flags,
) -> None:
    """Write the best motion (4, 4) and its consensus set (N,): see `pose_estimation.ransac`.

    seen (N, 3): the views' points, NaN for those that cannot be triangulated.
    """
    count = len(landmarks)
    usable, bearing = np.empty(count, np.int64), np.empty((count, 2))
    found, most, state = 0, 0, seed | np.uint64(1)
    for n in range(count):
        consensus[n] = False
        azimuth = camera[4] - (views[n, 0] + 0.5) / camera[0]
        bearing[n, 0], bearing[n, 1] = math.cos(azimuth), math.sin(azimuth)
        if math.isfinite(seen[n, 0]) and math.isfinite(seen[n, 1]) and math.isfinite(seen[n, 2]):
            usable[found] = n
            found += 1
    T, agree = np.empty((4, 4)), np.empty(count, np.bool_)
    for i in range(4):
        for j in range(4):
            best[i, j] = T[i, j] = 1.0 if i == j else 0.0
    if found < 3:
        return
    for hypothesis in range(1, RANSAC_BATCH * RANSAC_BATCHES + 1):
        a, b, c, state = triple(found, state)
        if not rigid_motion(landmarks, seen, usable[a], usable[b], usable[c], T):
            continue
        inliers = consensus_of(landmarks, views, bearing, camera, threshold_px, T, agree, most)
        if inliers > most:
            most = inliers
            for i in range(3):
                for j in range(4):
                    best[i, j] = T[i, j]
            for n in range(count):
                consensus[n] = agree[n]
        if hypothesis % RANSAC_BATCH == 0 and (1 - (most / count) ** 3) ** hypothesis < RANSAC_MISSED:
            return


@inner
def triple(count: int, state: np.uint64) -> tuple[int, int, int, np.uint64]:
    """Return three different indices below count, each triple equally likely, and the next state of the generator."""
    a, state = below(count, state)
    b, state = below(count - 1, state)
    c, state = below(count - 2, state)
    # The b-th of those without a, the c-th of those without a and b.
    if b >= a:
        b += 1
    low, high = min(a, b), max(a, b)
    if c >= low:
        c += 1
    if c >= high:
        c += 1
    return a, b, c, state


@inner
def below(count: int, state: np.uint64) -> tuple[int, np.uint64]:
    """Return a random index below count, and the next state (uint64, not 0) of the generator xorshift64*."""
    state ^= state >> _SHIFTS[0]
    state ^= state << _SHIFTS[1]
    state ^= state >> _SHIFTS[2]
    share = float((state * _MULTIPLIER) >> _HIGH_BITS) * _UNIT
    return min(math.floor(share * count), count - 1), state


@inner
def rigid_motion(landmarks: Array, seen: Array, a: int, b: int, c: int, T: Array) -> bool:
    """Write the motion (4, 4) that moves three landmarks onto the points seen with least squares; False if collinear.

    The least squares of Kabsch (1976) in closed form for triangles: their planes fall together, and in the plane the
    turn is that of complex numbers.
    """
    U, V = np.empty((3, 3)), np.empty((3, 3))
    if not triangle_axes(landmarks, a, b, c, U) or not triangle_axes(seen, a, b, c, V):
        return False
    along, across = 0.0, 0.0
    mean_from, mean_to = np.empty(3), np.empty(3)
    for i in range(3):
        mean_from[i] = (landmarks[a, i] + landmarks[b, i] + landmarks[c, i]) / 3
        mean_to[i] = (seen[a, i] + seen[b, i] + seen[c, i]) / 3
    for corner in range(3):
        n = a if corner == 0 else b if corner == 1 else c
        p, q, s, t = 0.0, 0.0, 0.0, 0.0
        for i in range(3):
            from_mean, to_mean = landmarks[n, i] - mean_from[i], seen[n, i] - mean_to[i]
            p, q = p + U[0, i] * from_mean, q + U[1, i] * from_mean
            s, t = s + V[0, i] * to_mean, t + V[1, i] * to_mean
        along += p * s + q * t
        across += p * t - q * s
    length = math.sqrt(along * along + across * across)
    if length == 0.0:
        return False
    cosine, sine = along / length, across / length
    for i in range(3):
        x, y = cosine * V[0, i] + sine * V[1, i], cosine * V[1, i] - sine * V[0, i]
        for j in range(3):
            T[i, j] = x * U[0, j] + y * U[1, j] + V[2, i] * U[2, j]
        T[i, 3] = mean_to[i] - (T[i, 0] * mean_from[0] + T[i, 1] * mean_from[1] + T[i, 2] * mean_from[2])
    return True


@inner
def triangle_axes(points: Array, a: int, b: int, c: int, axes: Array) -> bool:
    """Write two axes in the plane of three points and its normal, as rows (3, 3); False if the points are collinear."""
    ux, uy, uz = points[b, 0] - points[a, 0], points[b, 1] - points[a, 1], points[b, 2] - points[a, 2]
    vx, vy, vz = points[c, 0] - points[a, 0], points[c, 1] - points[a, 1], points[c, 2] - points[a, 2]
    nx, ny, nz = uy * vz - uz * vy, uz * vx - ux * vz, ux * vy - uy * vx
    u, n = math.sqrt(ux * ux + uy * uy + uz * uz), math.sqrt(nx * nx + ny * ny + nz * nz)
    if u == 0.0 or n == 0.0:
        return False
    ux, uy, uz, nx, ny, nz = ux / u, uy / u, uz / u, nx / n, ny / n, nz / n
    axes[0, 0], axes[0, 1], axes[0, 2] = ux, uy, uz
    axes[1, 0], axes[1, 1], axes[1, 2] = ny * uz - nz * uy, nz * ux - nx * uz, nx * uy - ny * ux
    axes[2, 0], axes[2, 1], axes[2, 2] = nx, ny, nz
    return True


@inner
def consensus_of(
    landmarks: Array,
    views: Array,
    bearing: Array,
    camera: CameraNumbers,
    threshold_px: float,
    T: Array,
    agree: Flags,
    least: int,
) -> int:
    """Write which views agree with a motion (N,) and return how many; -1 as soon as `least` is out of reach.

    The column is compared as the sine of the angle between the bearings, which needs no arctangent.
    """
    focal, row0, _, baseline, _ = camera
    largest_sine = math.sin(min(threshold_px / focal, math.pi / 2))
    count, left = 0, len(landmarks)
    for n in range(len(landmarks)):
        x, y, z = moved(T, landmarks[n, 0], landmarks[n, 1], landmarks[n, 2])
        r = max(math.sqrt(x * x + y * y), MIN_RADIUS_M)
        scale = focal / r
        lower = row0 - scale * z
        upper_error = views[n, 2] - lower - scale * baseline
        sine, cosine = bearing[n, 0] * y - bearing[n, 1] * x, bearing[n, 0] * x + bearing[n, 1] * y
        # An unknown upper row is NaN, and not larger than the threshold.
        agree[n] = (
            abs(views[n, 1] - lower) < threshold_px
            and not abs(upper_error) >= threshold_px
            and cosine > 0
            and abs(sine) < largest_sine * r
        )
        count += agree[n]
        left -= 1
        if count + left <= least:
            return -1
    return count
