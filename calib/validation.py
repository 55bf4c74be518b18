"""Checked values of calibration files: texts and their encodings, YAML and JSON, image sizes, rigid transforms.

YAML of unknown origin is bounded: it is short, and has no anchors.
"""

from __future__ import annotations

import json
import re
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from os import PathLike
from typing import Any, Final, TypeAlias

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
# A rotation within this of an orthonormal one is used as a program wrote it; others are made orthonormal.
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
    """Raise CalibError unless images of this size [px] are supported; key: names the value in the message."""
    whole = (width, height) == (int(width), int(height)) if np.isfinite([width, height]).all() else False
    if not (whole and min(width, height) >= 1 and max(width, height) <= MAX_SIDE_PX and width * height <= MAX_PIXELS):
        raise CalibError(
            f"{key}: expected width and height of images in whole pixels, 1 to {MAX_SIDE_PX}, at most {MAX_PIXELS} in "
            f"all, found {width:g} and {height:g}"
        )


def silent(line: str) -> None:
    """Report nothing."""


def transform_of(rows: Sequence[Sequence[float]] | None, key: str, warn: Warn = silent) -> Array:
    """Return the rigid transform (4, 4) with the rotation that is nearest to the numbers under a key.

    `warn` takes a line if the numbers have few digits.
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


# Of YAML, since a camera has about 60 numbers; of JSON, in which basalt also writes the vignettes of its cameras.
MAX_BYTES: Final = 1 << 15
MAX_JSON_BYTES: Final = 1 << 21
# The head of OpenCV's FileStorage, or of a YAML of another version; the tag marks a mapping of rows, cols and data.
_HEAD: Final = re.compile(r"\A\s*%YAML[:\s][^\n]*\n(\s*---[^\n]*\n)?")
_OPENCV_TAG: Final = re.compile(r"!!opencv-(nd-)?matrix\b")


def decode(data: bytes | str, name: str) -> str:
    """Return the text of a calibration file: UTF-8 or UTF-16 by its byte order mark, else UTF-8, else Latin-1.

    Numbers and keys are ASCII in each of them: only comments and names of topics differ.
    """
    if isinstance(data, str):
        return data.removeprefix("\ufeff")
    try:
        if data.startswith((b"\xff\xfe", b"\xfe\xff")):
            return data.decode("utf-16")
        return data.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        if b"\0" in data:
            raise CalibError(
                f"{name}: expected UTF-8 text, found byte {data[error.start]!r} at {error.start}"
            ) from error
        return data.decode("latin-1")


def load_mapping(data: str | bytes, name: str) -> Mapping[str, Any]:
    """Parse YAML or JSON (plain data only) and return its first document's mapping; matrices become lists of rows."""
    text = decode(data, name)
    values: Any = None
    try:
        if text.lstrip().startswith("{"):
            if len(text) > MAX_JSON_BYTES:
                raise ValueError(f"expected at most {MAX_JSON_BYTES} characters, found {len(text)}")
            with suppress(ValueError, RecursionError):  # else it may be YAML
                values = json.loads(text)
        if text.lstrip().startswith("<"):
            raise ValueError("it is XML: write it as .yml, with OpenCV's FileStorage")
        if values is None:
            values = _yaml(text)
    # ruamel.yaml raises all of these for damaged texts.
    except (YAMLError, ValueError, RecursionError, TypeError, LookupError, AttributeError, AssertionError) as error:
        raise CalibError(f"{name}: not a YAML file: {' '.join(str(error).split())[:200]}") from error
    if not isinstance(values, Mapping):
        found = "nothing" if values is None else type(values).__name__
        raise CalibError(f"{name}: expected a YAML mapping, found {found}")
    return {str(key): _with_rows(value) for key, value in values.items()}


def _yaml(text: str) -> Any:
    """Parse YAML; raise ValueError for one beyond the limits, and ruamel.yaml's error for a malformed one."""
    if len(text) > MAX_BYTES:
        raise ValueError(f"expected at most {MAX_BYTES} characters, found {len(text)}")
    # 1. The head, OpenCV's tags, and tabs, which YAML does not take for blanks.
    text = _OPENCV_TAG.sub("", _HEAD.sub("", text)).expandtabs(2)
    # 2. The events name anchors and aliases without resolving them.
    for event in YAML(typ="safe", pure=True).parse(text):
        if isinstance(event, AliasEvent) or (isinstance(event, NodeEvent) and event.anchor is not None):
            raise ValueError(f"expected no anchors and aliases, found {str(event.anchor)[:40]}; write the values out")
    # 3. The values of the first document: `ros2 topic echo` ends each message with a new one.
    return next(iter(YAML(typ="safe", pure=True).load_all(text)), None)


def _with_rows(value: Any) -> Any:
    """Replace each mapping with rows, cols and data within a value by a list of rows."""
    if isinstance(value, list):
        return [_with_rows(one) for one in value]
    if not isinstance(value, Mapping):
        return value
    rows, columns, data = value.get("rows"), value.get("cols"), value.get("data")
    if isinstance(data, list) and isinstance(rows, int) and isinstance(columns, int) and len(data) == rows * columns:
        return [data[row * columns : (row + 1) * columns] for row in range(rows)]
    return {str(key): _with_rows(one) for key, one in value.items()}
