"""Checks of what files state about cameras: sizes of files and images, and rigid transforms."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from os import PathLike
from typing import TypeAlias

import numpy as np

from calib import se3
from calib.errors import CalibError, within
from calib.models.camera import Array
from calib.typed_toml import bytes_of, shown

# Larger than any calibration with two embedded masks.
MAX_FILE_BYTES = 16_000_000
MAX_SIDE_PX = 32767  # because OpenCV's remap takes no larger images
MAX_PIXELS = 64 * 2**20  # because a mask of one byte a pixel must fit the memory
# A rotation typed with few digits is made orthonormal, so that one that a program wrote is not changed.
ORTHONORMAL_TOLERANCE = 1e-9
# Numbers of a rotation that are typed with three digits are this far off the nearest one; more are no rotation. Below
# the second bound, 0.001 degree, nothing is said.
TYPED_TOLERANCE, FEW_DIGITS = 1e-3, 1e-5
Warn: TypeAlias = Callable[[str], None]


def read_bytes(path: str | PathLike[str], limit: int = MAX_FILE_BYTES) -> bytes:
    """Read a calibration file of at most limit bytes."""
    with within(f"{path}: "):
        return bytes_of(path, limit)


def require_image_size(key: str, width: float, height: float) -> None:
    """Raise CalibError unless images of this size [px] are supported; key: what states it."""
    whole = (width, height) == (int(width), int(height)) if np.isfinite([width, height]).all() else False
    if not (whole and min(width, height) >= 1 and max(width, height) <= MAX_SIDE_PX and width * height <= MAX_PIXELS):
        raise CalibError(
            f"{key}: expected width and height of images in whole pixels, 1 to {MAX_SIDE_PX}, at most {MAX_PIXELS} in "
            f"all, found {width:g} and {height:g}"
        )


def silent(line: str) -> None:
    """Report nothing."""


def transform_of(rows: Sequence[Sequence[float]] | None, key: str, warn: Warn = silent) -> Array:
    """Return the rigid transform (4, 4) of the finite numbers under a key, with the nearest rotation.

    `warn` takes a line about numbers that were typed with few digits.
    """
    if rows is None or [len(row) for row in rows] != [4, 4, 4, 4]:
        raise CalibError(f"{key}: expected 4 rows of 4 numbers, found {'nothing' if rows is None else shown(rows)}")
    T = np.array(rows, float)
    R = se3.R_of(rigid(T)) if np.isfinite(T).all() else np.eye(3)
    off = float(np.abs(se3.R_of(T) - R).max())
    if not (off <= TYPED_TOLERANCE and np.linalg.det(R) > 0 and np.abs(T[3] - np.eye(4)[3]).max() <= 1e-4):
        most = f", up to {off:.2g} off a rotation" if np.isfinite(off) and np.linalg.det(R) > 0 else ""
        raise CalibError(f"{key}: expected a rotation and a translation over 0 0 0 1, found {shown(rows)}{most}")
    if off > FEW_DIGITS:
        warn(
            f"{key}: its numbers are up to {off:.1g} off a rotation, as typed with few digits: the nearest one is used"
        )
    return rigid(T)


def rigid(T: Array) -> Array:
    """Return T (4, 4) with an orthonormal rotation; T itself if its rotation is already orthonormal."""
    R = se3.R_of(T)
    if np.abs(R @ R.T - np.eye(3)).max() <= ORTHONORMAL_TOLERANCE:
        return T
    left, _, right = np.linalg.svd(R)
    return se3.transform(left @ right, se3.t_of(T))
