"""Checks of what files state about cameras: sizes of files and images, and rigid transforms."""

from __future__ import annotations

from collections.abc import Sequence
from os import PathLike

import numpy as np

from calib import se3
from calib.errors import CalibError
from calib.models.camera import Array
from calib.typed_toml import bytes_of, shown

# Larger than any calibration with two embedded masks.
MAX_FILE_BYTES = 16_000_000
MAX_SIDE_PX = 32767  # because OpenCV's remap takes no larger images
MAX_PIXELS = 64 * 2**20  # because a mask of one byte a pixel must fit the memory
# A rotation typed with few digits is made orthonormal, so that one that a program wrote is not changed.
ORTHONORMAL_TOLERANCE = 1e-9


def read_bytes(path: str | PathLike[str], limit: int = MAX_FILE_BYTES) -> bytes:
    """Read a calibration file of at most limit bytes."""
    try:
        return bytes_of(path, limit)
    except ValueError as error:
        raise CalibError(f"{path}: {error}") from error


def decode(data: bytes | str, name: str) -> str:
    """Return the text of a calibration file, UTF-8."""
    try:
        return data if isinstance(data, str) else data.decode()
    except UnicodeDecodeError as error:
        raise CalibError(f"{name}: expected UTF-8 text, found byte {data[error.start]!r} at {error.start}") from error


def is_image_size(width: float, height: float) -> bool:
    """True if images of this size [px] are supported."""
    return min(width, height) >= 1 and max(width, height) <= MAX_SIDE_PX and width * height <= MAX_PIXELS


def transform_of(rows: Sequence[Sequence[float]] | None, key: str) -> Array:
    """Return the rigid transform (4, 4) of the finite numbers under a key, with an orthonormal rotation."""
    if rows is None or [len(row) for row in rows] != [4, 4, 4, 4]:
        raise CalibError(f"{key}: expected 4 rows of 4 numbers, found {'nothing' if rows is None else shown(rows)}")
    T = np.array(rows, float)
    if not se3.is_rigid(T):
        raise CalibError(f"{key}: expected a rotation and a translation over 0 0 0 1, found {shown(rows)}")
    return rigid(T)


def rigid(T: Array) -> Array:
    """Return T (4, 4) with an orthonormal rotation; T itself if its rotation is already orthonormal."""
    R = T[:3, :3]
    if np.abs(R @ R.T - np.eye(3)).max() <= ORTHONORMAL_TOLERANCE:
        return T
    left, _, right = np.linalg.svd(R)
    return se3.transform(left @ right, T[:3, 3])
