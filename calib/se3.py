"""Rigid transforms as 4x4 matrices, `p_a = T_a_b @ p_b`; functions accept stacks (..., 4, 4).

Each formula is written once, in components. Those of a single transform are Python's floats, because a call of numpy
takes longer than ten of them, and the odometry makes some fifty such calls a frame; those of a stack are arrays.
"""

from __future__ import annotations

import math
from typing import Any, Final

import numpy as np
from numpy.typing import ArrayLike, NDArray

Array = NDArray[np.float64]
# Smaller angles are computed as this one: their terms differ by less than the rounding of what they are added to.
MIN_ANGLE_RAD: Final = 1e-9


def transform(R: ArrayLike, t: ArrayLike) -> Array:
    """Return the transform (..., 4, 4) of rotation R (..., 3, 3) and translation t (..., 3)."""
    R, t = np.asarray(R, float), np.asarray(t, float)
    T = np.zeros((*np.broadcast_shapes(R.shape[:-2], t.shape[:-1]), 4, 4))
    T[..., :-1, :-1], T[..., :-1, -1], T[..., -1, -1] = R, t, 1.0
    return T


def R_of(T: Array) -> Array:
    """Return the rotation (..., 3, 3) of T (..., 4, 4)."""
    return T[..., :-1, :-1]


def t_of(T: Array) -> Array:
    """Return the translation (..., 3) of T (..., 4, 4)."""
    return T[..., :-1, -1]


def inverse(T: ArrayLike) -> Array:
    """Return T_b_a of T_a_b: (R^T, -R^T t)."""
    (a, b, c, x), (d, e, f, y), (g, h, i, z), last = _elements(T)
    return _matrix(
        (a, d, g, -(a * x + d * y + g * z)),
        (b, e, h, -(b * x + e * y + h * z)),
        (c, f, i, -(c * x + f * y + i * z)),
        last,
    )


def apply(T: ArrayLike, points: ArrayLike) -> Array:
    """Transform points (..., N, 3) by T (..., 4, 4)."""
    T = np.asarray(T, float)
    return np.asarray(np.asarray(points, float) @ np.swapaxes(R_of(T), -1, -2) + t_of(T)[..., None, :])


def hat(w: ArrayLike) -> Array:
    """Return the cross-product matrix (..., 3, 3) of w (..., 3): hat(w) @ v = w x v."""
    x, y, z = _components(w)
    return _matrix((0.0, -z, y), (z, 0.0, -x), (-y, x, 0.0))


def exp(xi: ArrayLike) -> Array:
    """Return the transform (..., 4, 4) of a twist xi (..., 6) = [translation; rotation vector] (Rodrigues)."""
    tx, ty, tz, x, y, z = _components(xi)
    angle, m = _angle(x, y, z)
    # R = I + a W + b W^2 and t = (I + b W + c W^2) translation, with W = hat(w) and W^2 = w w^T - |w|^2 I.
    sine = m.sin(angle)
    a, b, c = sine / angle, 2 * (m.sin(angle / 2) / angle) ** 2, (angle - sine) / (angle * angle * angle)
    xx, yy, zz, xy, xz, yz = (b * v for v in (x * x, y * y, z * z, x * y, x * z, y * z))
    once = _cross((x, y, z), (tx, ty, tz))
    u, v, w = _cross((x, y, z), once)
    return _matrix(
        (1 - yy - zz, xy - a * z, xz + a * y, tx + b * once[0] + c * u),
        (xy + a * z, 1 - xx - zz, yz - a * x, ty + b * once[1] + c * v),
        (xz - a * y, yz + a * x, 1 - xx - yy, tz + b * once[2] + c * w),
        (0.0, 0.0, 0.0, 1.0),
    )


def log(T: ArrayLike) -> Array:
    """Return the twist (..., 6) = [translation; rotation vector] whose exp is T, for angles from 0 to pi inclusive."""
    (*_, tx), (*_, ty), (*_, tz), _ = rows = _elements(T)
    w = _rotation_vector(rows)
    angle, m = _angle(*w)
    # The inverse of I + b W + c W^2 is I - W / 2 + factor W^2.
    factor = (1 - angle / (2 * m.tan(angle / 2))) / (angle * angle)
    once = _cross(w, (tx, ty, tz))
    u, v, s = _cross(w, once)
    return _vector(tx - once[0] / 2 + factor * u, ty - once[1] / 2 + factor * v, tz - once[2] / 2 + factor * s, *w)


def rotation_exp(w: ArrayLike) -> Array:
    """Return the rotation matrix (..., 3, 3) of a rotation vector (..., 3) [rad]."""
    w = np.asarray(w, float)
    return R_of(exp(np.concatenate([np.zeros_like(w), w], axis=-1)))


def rotation_log(R: ArrayLike) -> Array:
    """Return the rotation vector (..., 3) [rad] of a rotation matrix, for angles from 0 to pi inclusive."""
    return _vector(*_rotation_vector(_elements(R)))


def adjoint(T: ArrayLike) -> Array:
    """Return the matrix (..., 6, 6) of T_a_b that maps twists [translation; rotation] from frame b to frame a."""
    T = np.asarray(T, float)
    R = R_of(T)
    A = np.zeros((*T.shape[:-2], 6, 6))
    A[..., :3, :3] = A[..., 3:, 3:] = R
    A[..., :3, 3:] = hat(t_of(T)) @ R
    return A


def quaternion(R: ArrayLike) -> Array:
    """Return the unit quaternion (..., 4) = (x, y, z, w), w >= 0, of R (..., 3, 3)."""
    return _vector(*_quaternion(_elements(R)))


def rotation(q: ArrayLike) -> Array:
    """Return the rotation matrix (..., 3, 3) of a quaternion (..., 4) = (x, y, z, w), which is normalised first."""
    q = np.asarray(q, float)
    x, y, z, w = _components(q / np.linalg.norm(q, axis=-1, keepdims=True))
    return _matrix(
        (1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)),
        (2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)),
        (2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)),
    )


def yaw(T: ArrayLike) -> Array:
    """Return the heading (...,) [rad] of the x axis of T about z."""
    T = np.asarray(T, float)
    return np.asarray(np.arctan2(T[..., 1, 0], T[..., 0, 0]))


def is_rigid(T: ArrayLike) -> bool:
    """True if T is a finite (4, 4) rotation and translation (no scale, no reflection), to three digits."""
    T = np.asarray(T, float)
    if T.shape != (4, 4) or not np.isfinite(T).all():
        return False
    rigid, R = np.eye(4), R_of(T)
    off = max(np.abs(R @ R.T - R_of(rigid)).max(), np.abs(T[-1] - rigid[-1]).max())
    return bool(off <= 1e-3 and np.linalg.det(R) > 0)


def _quaternion(rows: Any) -> Any:
    """Return the components x, y, z, w of `quaternion` of the rows of a rotation or a transform."""
    (xx, xy, xz, *_), (yx, yy, yz, *_), (zx, zy, zz, *_), *_ = rows
    # Four times the outer product q q^T: its longest column is the best conditioned estimate of q.
    columns = (
        (1 + xx - yy - zz, xy + yx, xz + zx, zy - yz),
        (xy + yx, 1 - xx + yy - zz, yz + zy, xz - zx),
        (xz + zx, yz + zy, 1 - xx - yy + zz, yx - xy),
        (zy - yz, xz - zx, yx - xy, 1 + xx + yy + zz),
    )
    diagonal = [column[k] for k, column in enumerate(columns)]
    if isinstance(xx, float):
        longest = columns[diagonal.index(max(diagonal))]
        length = math.hypot(*longest)
        return [value / (-length if longest[-1] < 0 else length) for value in longest]
    chosen = np.take_along_axis(np.array(columns), np.argmax(diagonal, axis=0)[None, None], axis=0)[0]
    return chosen / np.linalg.norm(chosen, axis=0) * np.where(chosen[-1] < 0, -1, 1)


def _rotation_vector(rows: Any) -> tuple[Any, Any, Any]:
    """Return the components of `rotation_log` of the rows of a rotation or a transform."""
    x, y, z, w = _quaternion(rows)
    half_sine, m = _angle(x, y, z)
    scale = 2 * (m.atan2 if m is math else m.arctan2)(half_sine, w) / half_sine
    return scale * x, scale * y, scale * z


def _angle(x: Any, y: Any, z: Any) -> tuple[Any, Any]:
    """Return the length of a vector by its components, MIN_ANGLE_RAD at least, and the module for such numbers."""
    if isinstance(x, float):
        return max(math.hypot(x, y, z), MIN_ANGLE_RAD), math
    return np.maximum(np.sqrt(x * x + y * y + z * z), MIN_ANGLE_RAD), np


def _cross(v: tuple[Any, Any, Any], w: tuple[Any, Any, Any]) -> tuple[Any, Any, Any]:
    """Return v x w."""
    return v[1] * w[2] - v[2] * w[1], v[2] * w[0] - v[0] * w[2], v[0] * w[1] - v[1] * w[0]


def _components(vector: ArrayLike) -> Any:
    """Return the components of a vector (N,) as floats, or those of vectors (..., N) as arrays (...)."""
    vector = np.asarray(vector, float)
    return vector.tolist() if vector.ndim == 1 else np.moveaxis(vector, -1, 0)


def _elements(matrix: ArrayLike) -> Any:
    """Return the rows of the elements of a matrix as floats, or those of matrices (..., N, N) as arrays (...)."""
    matrix = np.asarray(matrix, float)
    return matrix.tolist() if matrix.ndim == 2 else np.moveaxis(matrix, (-2, -1), (0, 1))


def _vector(*components: Any) -> Array:
    """Return a vector (N,) or vectors (..., N) of components."""
    return np.array(components) if isinstance(components[0], float) else np.stack(components, axis=-1)


def _matrix(*rows: Any) -> Array:
    """Return a matrix (N, M) or matrices (..., N, M) of the rows of their elements."""
    if isinstance(rows[0][-1], float):
        return np.array(rows)
    M = np.empty((*np.shape(rows[0][-1]), len(rows), len(rows[0])))
    for i, j in np.ndindex(*M.shape[-2:]):
        M[..., i, j] = rows[i][j]
    return M
