"""Rigid transforms as 4x4 matrices, `p_a = T_a_b @ p_b`; functions accept stacks (..., 4, 4).

A single transform is computed with Python's floats where it can be: a call of numpy takes longer than ten of them, and
the odometry makes some fifty such calls a frame.
"""

from __future__ import annotations

import math
from typing import TypeAlias

import numpy as np
from numpy.typing import ArrayLike, NDArray

Array = NDArray[np.float64]
Vector: TypeAlias = tuple[float, float, float]
Rows: TypeAlias = list[list[float]]  # of one matrix (3, 3)
# Below these the series, or the limit, is as exact as the formula.
SMALL_ANGLE_RAD = 1e-4
SMALL_NORM = 1e-9


def transform(R: ArrayLike, t: ArrayLike) -> Array:
    """Return the transform (..., 4, 4) of rotation R (..., 3, 3) and translation t (..., 3)."""
    R, t = np.asarray(R, float), np.asarray(t, float)
    T = np.zeros((*np.broadcast_shapes(R.shape[:-2], t.shape[:-1]), 4, 4))
    T[..., :3, :3], T[..., :3, 3], T[..., 3, 3] = R, t, 1.0
    return T


def inverse(T: ArrayLike) -> Array:
    """Return T_b_a of T_a_b: (R^T, -R^T t)."""
    T = np.asarray(T, float)
    if T.ndim == 2:
        (a, b, c, x), (d, e, f, y), (g, h, i, z), last = T.tolist()
        t = -(a * x + d * y + g * z), -(b * x + e * y + h * z), -(c * x + f * y + i * z)
        return np.array([[a, d, g, t[0]], [b, e, h, t[1]], [c, f, i, t[2]], last])
    R_inv = np.swapaxes(T[..., :3, :3], -1, -2)
    return transform(R_inv, -(R_inv @ T[..., :3, 3:])[..., 0])


def apply(T: ArrayLike, points: ArrayLike) -> Array:
    """Transform points (..., N, 3) by T (..., 4, 4)."""
    T = np.asarray(T, float)
    return np.asarray(np.asarray(points, float) @ np.swapaxes(T[..., :3, :3], -1, -2) + T[..., None, :3, 3])


def hat(w: ArrayLike) -> Array:
    """Return the cross-product matrix (..., 3, 3) of w (..., 3): hat(w) @ v = w x v."""
    w = np.asarray(w, float)
    if w.ndim == 1:
        x, y, z = w.tolist()
        return np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    W = np.zeros((*w.shape[:-1], 3, 3))
    W[..., 0, 1], W[..., 0, 2], W[..., 1, 2] = -w[..., 2], w[..., 1], -w[..., 0]
    return W - np.swapaxes(W, -1, -2)


def _series(angle: Array) -> tuple[Array, Array, Array]:
    """Return sin(a)/a, (1-cos(a))/a^2 and (a-sin(a))/a^3; by their series for small a."""
    small = angle < SMALL_ANGLE_RAD
    a = np.where(small, 1.0, angle)
    first = np.where(small, 1 - angle**2 / 6, np.sin(a) / a)
    second = np.where(small, 0.5 - angle**2 / 24, 2 * (np.sin(a / 2) / a) ** 2)
    third = np.where(small, 1 / 6 - angle**2 / 120, (a - np.sin(a)) / a**3)
    return first[..., None, None], second[..., None, None], third[..., None, None]


def _series_of_one(angle: float) -> tuple[float, float, float]:
    """Return `_series` of one angle."""
    if angle < SMALL_ANGLE_RAD:
        return 1 - angle**2 / 6, 0.5 - angle**2 / 24, 1 / 6 - angle**2 / 120
    sine = math.sin(angle)
    return sine / angle, 2 * (math.sin(angle / 2) / angle) ** 2, (angle - sine) / angle**3


def rotation_exp(w: ArrayLike) -> Array:
    """Return the rotation matrix (..., 3, 3) of a rotation vector (..., 3) [rad] (Rodrigues)."""
    w = np.asarray(w, float)
    a, b, _ = _series(np.linalg.norm(w, axis=-1))
    W = hat(w)
    return np.asarray(np.eye(3) + a * W + b * W @ W)


def rotation_log(R: ArrayLike) -> Array:
    """Return the rotation vector (..., 3) [rad] of a rotation matrix, for angles from 0 to pi inclusive."""
    R = np.asarray(R, float)
    if R.ndim == 2:
        return np.array(_rotation_log_of_one(R.tolist()))
    q = quaternion(R)
    norm = np.linalg.norm(q[..., :3], axis=-1)
    angle = 2 * np.arctan2(norm, q[..., 3])
    small = norm < SMALL_NORM
    scale = np.where(small, 2.0, angle / np.where(small, 1.0, norm))
    return np.asarray(q[..., :3] * scale[..., None])


def _rotation_log_of_one(R: Rows) -> Vector:
    """Return `rotation_log` of one matrix."""
    x, y, z, real = _quaternion_of_one(R)
    length = math.hypot(x, y, z)
    scale = 2.0 if length < SMALL_NORM else 2 * math.atan2(length, real) / length
    return scale * x, scale * y, scale * z


def _cross(v: Vector, w: Vector) -> Vector:
    """Return v x w."""
    return v[1] * w[2] - v[2] * w[1], v[2] * w[0] - v[0] * w[2], v[0] * w[1] - v[1] * w[0]


def exp(xi: ArrayLike) -> Array:
    """Return the transform (..., 4, 4) of a twist xi (..., 6) = [translation; rotation vector]."""
    xi = np.asarray(xi, float)
    if xi.ndim == 1:
        return _exp_of_one(xi)
    a, b, c = _series(np.linalg.norm(xi[..., 3:], axis=-1))
    W = hat(xi[..., 3:])
    R, V = np.eye(3) + a * W + b * W @ W, np.eye(3) + b * W + c * W @ W
    return transform(R, (V @ xi[..., :3, None])[..., 0])


def _exp_of_one(xi: Array) -> Array:
    """Return `exp` of one twist (6,)."""
    tx, ty, tz, x, y, z = xi.tolist()
    first, second, third = _series_of_one(math.hypot(x, y, z))
    # hat(w)^2 = w w^T - |w|^2 I
    xx, yy, zz, xy, xz, yz = (second * v for v in (x * x, y * y, z * z, x * y, x * z, y * z))
    once = _cross((x, y, z), (tx, ty, tz))
    twice = _cross((x, y, z), once)
    a, b, c = first * x, first * y, first * z
    return np.array(
        [
            [1 - yy - zz, xy - c, xz + b, tx + second * once[0] + third * twice[0]],
            [xy + c, 1 - xx - zz, yz - a, ty + second * once[1] + third * twice[1]],
            [xz - b, yz + a, 1 - xx - yy, tz + second * once[2] + third * twice[2]],
            [0.0, 0.0, 0.0, 1.0],
        ]
    )


def log(T: ArrayLike) -> Array:
    """Return the twist (..., 6) = [translation; rotation vector] whose exp is T."""
    T = np.asarray(T, float)
    if T.ndim == 2:
        return _log_of_one(T)
    w = rotation_log(T[..., :3, :3])
    _, b, c = _series(np.linalg.norm(w, axis=-1))
    W = hat(w)
    V = np.eye(3) + b * W + c * W @ W
    return np.concatenate([np.linalg.solve(V, T[..., :3, 3:])[..., 0], w], axis=-1)


def _log_of_one(T: Array) -> Array:
    """Return `log` of one transform, with the inverse of V in closed form: I - W/2 + (1 - a/2 cot(a/2)) / a^2 W^2."""
    rows = T.tolist()
    w = _rotation_log_of_one([row[:3] for row in rows[:3]])
    t, angle = (rows[0][3], rows[1][3], rows[2][3]), math.hypot(*w)
    half, square = angle / 2, angle * angle
    factor = 1 / 12 + square / 720 if angle < SMALL_ANGLE_RAD else (1 - half / math.tan(half)) / square
    once = _cross(w, t)
    twice = _cross(w, once)
    return np.array([*(t[k] - once[k] / 2 + factor * twice[k] for k in range(3)), *w])


def adjoint(T: ArrayLike) -> Array:
    """Return the matrix (..., 6, 6) of T_a_b that maps twists [translation; rotation] from frame b to frame a."""
    T = np.asarray(T, float)
    R = T[..., :3, :3]
    A = np.zeros((*T.shape[:-2], 6, 6))
    A[..., :3, :3] = A[..., 3:, 3:] = R
    A[..., :3, 3:] = hat(T[..., :3, 3]) @ R
    return A


def quaternion(R: ArrayLike) -> Array:
    """Return the unit quaternion (..., 4) = (x, y, z, w), w >= 0, of R (..., 3, 3)."""
    R = np.asarray(R, float)
    if R.ndim == 2:
        return np.array(_quaternion_of_one(R.tolist()))
    xx, yy, zz = R[..., 0, 0], R[..., 1, 1], R[..., 2, 2]
    # Four times the outer product q q^T: its longest column is the best conditioned estimate of q.
    K = np.empty((*R.shape[:-2], 4, 4))
    K[..., 0, 0], K[..., 1, 1] = 1 + xx - yy - zz, 1 - xx + yy - zz
    K[..., 2, 2], K[..., 3, 3] = 1 - xx - yy + zz, 1 + xx + yy + zz
    K[..., 0, 1] = K[..., 1, 0] = R[..., 0, 1] + R[..., 1, 0]
    K[..., 0, 2] = K[..., 2, 0] = R[..., 0, 2] + R[..., 2, 0]
    K[..., 1, 2] = K[..., 2, 1] = R[..., 1, 2] + R[..., 2, 1]
    K[..., 0, 3] = K[..., 3, 0] = R[..., 2, 1] - R[..., 1, 2]
    K[..., 1, 3] = K[..., 3, 1] = R[..., 0, 2] - R[..., 2, 0]
    K[..., 2, 3] = K[..., 3, 2] = R[..., 1, 0] - R[..., 0, 1]
    longest = np.argmax(np.einsum("...ii->...i", K), axis=-1)
    q = np.take_along_axis(K, longest[..., None, None], axis=-1)[..., 0]
    q = q / np.linalg.norm(q, axis=-1, keepdims=True)
    return np.asarray(np.where(q[..., 3:] < 0, -q, q))


def _quaternion_of_one(R: Rows) -> tuple[float, float, float, float]:
    """Return `quaternion` of one matrix."""
    (xx, xy, xz), (yx, yy, yz), (zx, zy, zz) = R
    columns = (
        (1 + xx - yy - zz, xy + yx, xz + zx, zy - yz),
        (xy + yx, 1 - xx + yy - zz, yz + zy, xz - zx),
        (xz + zx, yz + zy, 1 - xx - yy + zz, yx - xy),
        (zy - yz, xz - zx, yx - xy, 1 + xx + yy + zz),
    )
    diagonal = [column[k] for k, column in enumerate(columns)]
    longest = columns[diagonal.index(max(diagonal))]
    length = math.hypot(*longest)
    sign = -1.0 if longest[3] < 0 else 1.0
    x, y, z, real = (sign * value / length for value in longest)
    return x, y, z, real


def rotation(q: ArrayLike) -> Array:
    """Return the rotation matrix (..., 3, 3) of a quaternion (..., 4) = (x, y, z, w), which is normalised first."""
    given = np.asarray(q, float)
    unit = given / np.linalg.norm(given, axis=-1, keepdims=True)
    W = hat(unit[..., :3])
    return np.asarray(np.eye(3) + 2 * unit[..., 3, None, None] * W + 2 * W @ W)


def yaw(T: ArrayLike) -> Array:
    """Return the heading (...,) [rad] of the x axis of T about z."""
    T = np.asarray(T, float)
    return np.asarray(np.arctan2(T[..., 1, 0], T[..., 0, 0]))


def is_rigid(T: ArrayLike, tolerance: float = 1e-4) -> bool:
    """True if T is a finite (4, 4) rotation and translation (no scale, no reflection)."""
    T = np.asarray(T, float)
    if T.shape != (4, 4) or not np.isfinite(T).all() or not _is_close(T[3], np.eye(4)[3], tolerance):
        return False
    R = T[:3, :3]
    return bool(_is_close(R @ R.T, np.eye(3), tolerance) and np.linalg.det(R) > 0)


def _is_close(found: Array, expected: Array, tolerance: float) -> bool:
    """Return np.allclose(found, expected, atol=tolerance) of finite numbers, in a tenth of its time."""
    return bool((np.abs(found - expected) <= tolerance + 1e-5 * np.abs(expected)).all())
