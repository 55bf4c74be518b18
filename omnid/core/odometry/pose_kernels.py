"""Compiled part of the pose estimation: see pose_estimation.py for the method and the meaning of the arguments.

camera: (focal_px, row0, width [px], baseline_m) of the panoramas.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from omnid.core.compiled import compiled, inner

Array = NDArray[np.float64]
Flags = NDArray[np.bool_]
Indices = NDArray[np.intp]
CameraNumbers = tuple[float, float, float, float]

RANSAC_BATCH, RANSAC_BATCHES = 12, 40  # hypotheses between two tests whether the search may end, and most of those
RANSAC_MISSED = 1e-6  # probability that no hypothesis was free of outliers, at which the search ends
KERNEL_WIDTH = 2.5  # standard deviations at which the Cauchy kernel halves the weight of an error
DAMPING = 1e-9  # added to the normal equations' diagonal, so that few landmarks do not make them singular
MIN_RADIUS_M = 1e-9  # from the axis: a point on it has no disparity
SMALL_RAD = 1e-4  # below which the series of exp is as exact as the formula
# Constants of Marsaglia's xorshift generator with a multiplier (xorshift64*, Vigna 2016).
_MULTIPLIER = np.uint64(2685821657736338717)
_SHIFTS = np.uint64(12), np.uint64(25), np.uint64(27)
_HIGH_BITS, _UNIT = np.uint64(11), 2.0**-53


@inner
def robust_weight(squared: float) -> float:
    """Return the weight of a view with a squared Mahalanobis distance: that of the Cauchy kernel.

    Compared with a mixture of two Gaussian distributions in tests/experiments/mixture_noise.py.
    """
    return 1 / (1 + squared / KERNEL_WIDTH**2)


@compiled("(f8[:, :], f8[:, :, :], f8[:, :], f8[:, :], UniTuple(f8, 4), f8, f8[:, :, :], f8[:, :, ::1])", writes=("W",))
def whiten(landmarks: Array, covariance: Array, views: Array, T: Array, camera: CameraNumbers, sigma_px: float,
           noise: Array, W: Array) -> None:
    """Write `pose_estimation.whitening` into W (N, 3, 3); noise (N, 3, 3), or (0, 3, 3) for none."""
    focal, _, _, baseline = camera
    J, S, JR = np.empty((3, 3)), np.empty((3, 3)), np.empty((3, 3))
    for n in range(len(landmarks)):
        x, y, z = moved(T, landmarks[n, 0], landmarks[n, 1], landmarks[n, 2])
        per_r = 1 / max(math.sqrt(x * x + y * y), MIN_RADIUS_M)
        scale = focal * per_r
        J[0, 0], J[0, 1], J[0, 2] = scale * y * per_r, -scale * x * per_r, 0.0
        for row in range(1, 3):
            outward = scale * per_r * per_r * (z if row == 1 else z - baseline)
            J[row, 0], J[row, 1], J[row, 2] = outward * x, outward * y, -scale
        for a in range(3):
            for b in range(3):
                JR[a, b] = J[a, 0] * T[0, b] + J[a, 1] * T[1, b] + J[a, 2] * T[2, b]
        for a in range(3):
            for b in range(a + 1):
                total = sigma_px * sigma_px if a == b else 0.0
                for c in range(3):
                    for d in range(3):
                        total += JR[a, c] * covariance[n, c, d] * JR[b, d]
                if len(noise):
                    total += noise[n, a, b]
                S[a, b] = total
        lower_only = math.isnan(views[n, 2])
        if lower_only:
            S[2, 0], S[2, 1], S[2, 2] = 0.0, 0.0, 1.0
        write_inverse_cholesky(S, W[n])
        if lower_only:
            W[n, 2, 0], W[n, 2, 1], W[n, 2, 2] = 0.0, 0.0, 0.0


@inner
def write_inverse_cholesky(S: Array, W: Array) -> None:
    """Write the inverse (3, 3) of the lower Cholesky factor of S (3, 3), of which the lower triangle is read."""
    l00 = math.sqrt(S[0, 0])
    l10, l20 = S[1, 0] / l00, S[2, 0] / l00
    l11 = math.sqrt(S[1, 1] - l10 * l10)
    l21 = (S[2, 1] - l20 * l10) / l11
    l22 = math.sqrt(S[2, 2] - l20 * l20 - l21 * l21)
    W[0, 0], W[1, 1], W[2, 2] = 1 / l00, 1 / l11, 1 / l22
    W[1, 0], W[2, 1] = -l10 * W[0, 0] * W[1, 1], -l21 * W[1, 1] * W[2, 2]
    W[2, 0] = -(l20 * W[0, 0] + l21 * W[1, 0]) * W[2, 2]
    W[0, 1], W[0, 2], W[1, 2] = 0.0, 0.0, 0.0


@compiled("(f8[:, :], f8[:, :], f8[:, :, ::1], f8[:, :, ::1], f8[:, :], UniTuple(f8, 4), i8, f8, "
          "f8[:, ::1], f8[::1], f8[:, ::1], f8[::1])", writes=("T", "error", "inverse", "squared"))
def gauss_newton(landmarks: Array, views: Array, W: Array, derivatives: Array, prior: Array, camera: CameraNumbers,
                 steps: int, converged: float, T: Array, error: Array, inverse: Array, squared: Array) -> None:
    """Improve the motion T (4, 4) and the shared error (K,); see `pose_estimation.gauss_newton`.

    derivatives (N, 3, K) of the views by the shared error, prior (K, K) the inverse of its covariance. Also writes the
    inverse (6 + K, 6 + K) of the normal equations and the squared errors (N,).
    """
    size = 6 + len(error)
    H, g, step = np.empty((size, size)), np.empty(size), np.empty(size)
    factor = np.empty((size, size))
    accumulate(landmarks, views, W, derivatives, prior, camera, T, error, H, g, squared)
    for _ in range(steps):
        factorise(H, factor)
        solve(factor, g, step)
        left_multiply_exp(step, T)
        largest = 0.0
        for a in range(6):
            largest = max(largest, abs(step[a]))
        for a in range(6, size):
            error[a - 6] += step[a]
        if largest < converged:
            break  # the last equations hold here as well
        accumulate(landmarks, views, W, derivatives, prior, camera, T, error, H, g, squared)
    factorise(H, factor)
    for a in range(size):
        g[:] = 0.0
        g[a] = 1.0
        solve(factor, g, inverse[a])


@inner
def accumulate(landmarks: Array, views: Array, W: Array, derivatives: Array, prior: Array, camera: CameraNumbers,
               T: Array, error: Array, H: Array, g: Array, squared: Array) -> None:
    """Write the normal equations H [step; change] = g, and the squared errors (N,) of the views.

    step: [t; r] on the left of T; change (K,): of the shared error.
    """
    size = len(g)
    H[:], g[:] = 0.0, 0.0
    J, e, J_white, e_white = np.zeros((3, size)), np.empty(3), np.zeros((3, size)), np.empty(3)
    for n in range(len(landmarks)):
        linearise(landmarks[n], views[n], camera, T, J, e)
        for k in range(6, size):
            for row in range(3):
                J[row, k] = -derivatives[n, row, k - 6]
                e[row] += derivatives[n, row, k - 6] * error[k - 6]
        # Whitening: W is a lower triangle.
        total = 0.0
        for row in range(3):
            e_white[row] = 0.0
            for inner_row in range(row + 1):
                e_white[row] += W[n, row, inner_row] * e[inner_row]
            for k in range(size):
                J_white[row, k] = W[n, row, 0] * J[0, k]
            for inner_row in range(1, row + 1):
                for k in range(size):
                    J_white[row, k] += W[n, row, inner_row] * J[inner_row, k]
            total += e_white[row] * e_white[row]
        squared[n] = total
        weight = robust_weight(total)
        for row in range(3):
            for a in range(size):
                weighted = weight * J_white[row, a]
                g[a] += weighted * e_white[row]
                for b in range(a + 1):
                    H[a, b] += weighted * J_white[row, b]
    for a in range(size):
        H[a, a] += DAMPING
        for b in range(a):
            H[b, a] = H[a, b]
    for a in range(6, size):
        for b in range(6, size):
            H[a, b] += prior[a - 6, b - 6]
            g[a] -= prior[a - 6, b - 6] * error[b - 6]


@inner
def linearise(landmark: Array, seen: Array, camera: CameraNumbers, T: Array, J: Array, e: Array) -> None:
    """Write the derivatives (3, 6) by [t; r] and the error (3,) of the view of a landmark; 0 for an unknown row."""
    focal, row0, width, baseline = camera
    x, y, z = moved(T, landmark[0], landmark[1], landmark[2])
    per_r = 1 / max(math.sqrt(x * x + y * y), MIN_RADIUS_M)
    along_x, along_y, scale = x * per_r, y * per_r, focal * per_r
    lower = row0 - scale * z
    column = (math.pi - math.atan2(y, x)) * focal - 0.5
    e[0] = wrapped(seen[0] - column, width)
    e[1] = seen[1] - lower
    e[2] = 0.0 if math.isnan(seen[2]) else seen[2] - lower - scale * baseline
    # Column: f (pi - atan2(y, x)); its derivative by a turn about z is -f.
    J[0, 0], J[0, 1], J[0, 2] = scale * along_y, -scale * along_x, 0.0
    J[0, 3], J[0, 4], J[0, 5] = -z * J[0, 1], z * J[0, 0], -focal
    # Rows: row0 - f height / r; a turn about z does not change them.
    for row in range(1, 3):
        outward = scale * per_r * (z if row == 1 else z - baseline)
        J[row, 0], J[row, 1], J[row, 2] = outward * along_x, outward * along_y, -scale
        J[row, 3], J[row, 4] = y * J[row, 2] - z * J[row, 1], z * J[row, 0] - x * J[row, 2]
        J[row, 5] = 0.0


@inner
def moved(T: Array, x: float, y: float, z: float) -> tuple[float, float, float]:
    """Return the point T p."""
    return (T[0, 0] * x + T[0, 1] * y + T[0, 2] * z + T[0, 3], T[1, 0] * x + T[1, 1] * y + T[1, 2] * z + T[1, 3],
            T[2, 0] * x + T[2, 1] * y + T[2, 2] * z + T[2, 3])


@inner
def wrapped(difference: float, width: float) -> float:
    """Return a difference of columns in [-width / 2, width / 2)."""
    return difference - width * math.floor(difference / width + 0.5)


@inner
def factorise(H: Array, factor: Array) -> None:
    """Write the lower Cholesky factor of H (M, M), which is positive definite."""
    for a in range(len(H)):
        for b in range(a + 1):
            total = H[a, b]
            for c in range(b):
                total -= factor[a, c] * factor[b, c]
            factor[a, b] = math.sqrt(total) if a == b else total / factor[b, b]


@inner
def solve(factor: Array, g: Array, x: Array) -> None:
    """Write the solution of L L^T x = g for a lower factor L (M, M)."""
    size = len(g)
    for a in range(size):
        total = g[a]
        for c in range(a):
            total -= factor[a, c] * x[c]
        x[a] = total / factor[a, a]
    for a in range(size - 1, -1, -1):
        total = x[a]
        for c in range(a + 1, size):
            total -= factor[c, a] * x[c]
        x[a] = total / factor[a, a]


@inner
def left_multiply_exp(twist: Array, T: Array) -> None:
    """Replace T (4, 4) by exp(twist) T; twist (6,) or more: [translation; rotation vector], as `se3.exp`."""
    wx, wy, wz = twist[3], twist[4], twist[5]
    angle2 = wx * wx + wy * wy + wz * wz
    angle = math.sqrt(angle2)
    if angle < SMALL_RAD:
        a, b, c = 1 - angle2 / 6, 0.5 - angle2 / 24, 1 / 6 - angle2 / 120
    else:
        a, b = math.sin(angle) / angle, 2 * (math.sin(angle / 2) / angle) ** 2
        c = (angle - math.sin(angle)) / (angle2 * angle)
    W = np.zeros((3, 3))
    W[0, 1], W[0, 2], W[1, 2] = -wz, wy, -wx
    W[1, 0], W[2, 0], W[2, 1] = wz, -wy, wx
    R, V, before = np.empty((3, 3)), np.empty((3, 3)), T.copy()
    for i in range(3):
        for j in range(3):
            square = W[i, 0] * W[0, j] + W[i, 1] * W[1, j] + W[i, 2] * W[2, j]
            one = 1.0 if i == j else 0.0
            R[i, j], V[i, j] = one + a * W[i, j] + b * square, one + b * W[i, j] + c * square
    for i in range(3):
        for j in range(4):
            T[i, j] = R[i, 0] * before[0, j] + R[i, 1] * before[1, j] + R[i, 2] * before[2, j]
        T[i, 3] += V[i, 0] * twist[0] + V[i, 1] * twist[1] + V[i, 2] * twist[2]


@compiled("(f8[:, :], f8[:, :], f8[:, :], UniTuple(f8, 4), f8, u8, f8[:, ::1], b1[::1])", writes=("best", "consensus"))
def ransac(landmarks: Array, views: Array, seen: Array, camera: CameraNumbers, threshold_px: float, seed: np.uint64,
           best: Array, consensus: Flags) -> None:
    """Write the best motion (4, 4) and its consensus set (N,): see `pose_estimation.ransac`.

    seen (N, 3): the views' points, NaN for those that cannot be triangulated.
    """
    count = len(landmarks)
    usable, bearing = np.empty(count, np.int64), np.empty((count, 2))
    found = 0
    for n in range(count):
        azimuth = math.pi - (views[n, 0] + 0.5) / camera[0]
        bearing[n, 0], bearing[n, 1] = math.cos(azimuth), math.sin(azimuth)
        if math.isfinite(seen[n, 0]) and math.isfinite(seen[n, 1]) and math.isfinite(seen[n, 2]):
            usable[found] = n
            found += 1
    consensus[:], best[:] = False, np.eye(4)
    if found < 3:
        return
    T, agree = np.eye(4), np.empty(count, np.bool_)
    most, state = 0, seed | np.uint64(1)
    for hypothesis in range(1, RANSAC_BATCH * RANSAC_BATCHES + 1):
        a, b, c, state = triple(found, state)
        if not rigid_motion(landmarks, seen, usable[a], usable[b], usable[c], T):
            continue
        inliers = consensus_of(landmarks, views, bearing, camera, threshold_px, T, agree, most)
        if inliers > most:
            most = inliers
            best[:], consensus[:] = T, agree
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
    return min(int(share * count), count - 1), state


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
def consensus_of(landmarks: Array, views: Array, bearing: Array, camera: CameraNumbers, threshold_px: float, T: Array,
                 agree: Flags, least: int) -> int:
    """Write which views agree with a motion (N,) and return how many; -1 as soon as `least` is out of reach.

    The column is compared as the sine of the angle between the bearings, which needs no arctangent.
    """
    focal, row0, _, baseline = camera
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
        agree[n] = (abs(views[n, 1] - lower) < threshold_px and not abs(upper_error) >= threshold_px and cosine > 0
                    and abs(sine) < largest_sine * r)
        count += agree[n]
        left -= 1
        if count + left <= least:
            return -1
    return count
