"""Values in the rows of a map file: numbers, arrays and transforms, checked as they are read."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, Final

import numpy as np
from numpy.typing import DTypeLike, NDArray

Array = NDArray[np.float64]

MAX_INTEGER: Final = 1 << 62
MAX_POSITION_M: Final = 1e5
MAX_VARIANCE: Final = 1e8  # m^2 and rad^2
RIGID: Final = 1e-6  # Largest difference of an element of R R^T from the identity.


class BadRowError(ValueError):
    """A row that no omnid has written."""


def as_bytes(values: NDArray[Any], dtype: str) -> bytes:
    """Return the elements of an array, as a type of a given byte order."""
    return np.ascontiguousarray(values, np.dtype(dtype)).tobytes()


def rows_of(value: object, dtype: DTypeLike, columns: int) -> NDArray[Any]:
    """Return an array (N, columns) with any number of rows. Raises BadRowError."""
    kind = np.dtype(dtype)
    if not isinstance(value, bytes) or len(value) % (kind.itemsize * columns):
        raise BadRowError("an array has another size")
    return np.frombuffer(value, kind).reshape(-1, columns).astype(kind.newbyteorder("="))


def arrays_of(values: Sequence[object], dtype: DTypeLike, shape: tuple[int, ...]) -> NDArray[Any]:
    """Return N arrays of one shape (...) as one array (N, ...), which can be written to. Raises BadRowError."""
    kind = np.dtype(dtype)
    size = kind.itemsize * math.prod(shape)
    known = [value for value in values if isinstance(value, bytes) and len(value) == size]
    if len(known) != len(values):
        raise BadRowError("an array has another size")
    return (
        np.frombuffer(bytearray(b"".join(known)), kind).reshape(-1, *shape).astype(kind.newbyteorder("="), copy=False)
    )


def transforms_of(values: Sequence[object]) -> Array:
    """Return transforms (N, 4, 4); a file holds their upper three rows. Raises BadRowError."""
    upper = arrays_of(values, "<f8", (3, 4))
    return np.concatenate([upper, np.broadcast_to([0.0, 0.0, 0.0, 1.0], (len(upper), 1, 4))], axis=1)


def transform_of(value: object) -> Array:
    """Return a transform (4, 4). Raises BadRowError."""
    return np.asarray(transforms_of([value])[0])


def integer(value: object, low: int = 0, high: int = MAX_INTEGER) -> int:
    """Return a whole number within its range. Raises BadRowError."""
    if not isinstance(value, int) or not low <= value <= high:
        raise BadRowError("a number is missing or outside its range")
    return value


def number(value: object, low: float, high: float) -> float:
    """Return a number within its range. Raises BadRowError."""
    if not isinstance(value, float) or not low <= value <= high:
        raise BadRowError("a number is missing or outside its range")
    return value


def require_rigid(transforms: Sequence[Array]) -> None:
    """Check that all (4, 4) are rotations with translations up to MAX_POSITION_M. Raises BadRowError."""
    if not transforms:
        return
    T = np.array(transforms)
    R = T[:, :3, :3]
    if not np.isfinite(T).all() or (np.abs(T[:, :3, 3]) > MAX_POSITION_M).any() or (np.abs(R) > 2).any():
        raise BadRowError("a pose is not finite, or too far away")
    if (np.abs(R @ np.swapaxes(R, 1, 2) - np.eye(3)) > RIGID).any() or (np.linalg.det(R) < 0).any():
        raise BadRowError("a pose is no rotation")


def require_covariances(covariances: Sequence[Array], least: float) -> None:
    """Check that all (6, 6) are symmetric, without an eigenvalue below `least` [m^2, rad^2]. Raises BadRowError."""
    if not covariances:
        return
    P = np.array(covariances)
    if not np.isfinite(P).all() or (np.abs(P) > MAX_VARIANCE).any():
        raise BadRowError("a covariance is not finite, or too large")
    rounding = 1e-9 * np.abs(P).max(axis=(1, 2))  # an eigenvalue that is 0 may be less by this
    if (np.abs(P - np.swapaxes(P, 1, 2)).max(axis=(1, 2)) > rounding).any():
        raise BadRowError("a covariance is not symmetric")
    if (np.linalg.eigvalsh(P)[:, 0] < (least or -rounding)).any():
        raise BadRowError("a covariance is not positive")
