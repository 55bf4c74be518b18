"""Checked values of calibration files: texts, YAML, image sizes, rigid transforms.

YAML of unknown origin is bounded: it is short, and has no anchors.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from os import PathLike
from typing import Any, TypeAlias

import numpy as np
from ruamel.yaml import YAML
from ruamel.yaml.error import YAMLError
from ruamel.yaml.events import AliasEvent, NodeEvent

from calib import se3
from calib.errors import CalibError, within
from calib.models.camera import Array
from calib.typed_toml import bytes_of, shown

# Larger than any calibration with two embedded masks.
MAX_FILE_BYTES = 16_000_000
MAX_SIDE_PX = 32767  # because OpenCV's remap takes no larger images
MAX_PIXELS = 64 * 2**20  # because a mask of one byte a pixel must fit the memory
LineReporter: TypeAlias = Callable[[str], None]  # receives warnings, or the progress of a long calibration


def read_bytes(path: str | PathLike[str]) -> bytes:
    """Read a calibration file of at most MAX_FILE_BYTES."""
    with within(f"{path}: "):
        return bytes_of(path, MAX_FILE_BYTES)


def read_text(path: str | PathLike[str]) -> str:
    """Read a calibration file of UTF-8 text."""
    with within(f"{path}: "):
        return read_bytes(path).decode("utf-8-sig")


def require_image_size(key: str, width: float, height: float) -> None:
    """Raise CalibError unless images of this size [px] are supported; key: names the value in the message."""
    whole = (width, height) == (int(width), int(height)) if np.isfinite([width, height]).all() else False
    if not (whole and min(width, height) >= 1 and max(width, height) <= MAX_SIDE_PX and width * height <= MAX_PIXELS):
        raise CalibError(
            f"{key}: expected width and height of images in whole pixels, 1 to {MAX_SIDE_PX}, at most {MAX_PIXELS} in "
            f"all, found {width:g} and {height:g}"
        )


def silent(line: str) -> None:
    """Report nothing."""


def transform_of(rows: Sequence[Sequence[float]] | None, key: str) -> Array:
    """Return the rigid transform (4, 4) with the rotation that is nearest to the numbers under a key."""
    if rows is None or [len(row) for row in rows] != [4, 4, 4, 4]:
        raise CalibError(f"{key}: expected 4 rows of 4 numbers, found {'nothing' if rows is None else shown(rows)}")
    T = np.array(rows, float)
    if not se3.is_rigid(T):
        raise CalibError(f"{key}: expected a rotation and a translation over 0 0 0 1, found {shown(rows)}")
    R = se3.R_of(T)
    if np.allclose(R @ R.T, np.eye(3), rtol=0):
        return T
    left, _, right = np.linalg.svd(R)
    return se3.transform(left @ right, se3.t_of(T))


def load_yaml(text: str) -> Any:
    """Return the value of a YAML text (plain data only); CalibError for a malformed one."""
    try:
        # The events name anchors and aliases without resolving them, which would let a short text grow.
        for event in YAML(typ="safe", pure=True).parse(text):
            if isinstance(event, AliasEvent) or (isinstance(event, NodeEvent) and event.anchor is not None):
                raise ValueError("no anchors and aliases are read: write the values out")
        return YAML(typ="safe", pure=True).load(text)
    # ruamel.yaml raises all of these for damaged texts.
    except (YAMLError, ValueError, RecursionError, TypeError, LookupError, AttributeError, AssertionError) as error:
        raise CalibError(f"not a YAML file: {' '.join(str(error).split())[:200]}") from error
