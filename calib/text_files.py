"""Texts of calibrations by other programs: their encodings, YAML (also of OpenCV's FileStorage) and JSON.

YAML of unknown origin is bounded: it is short, and has no anchors.
"""

from __future__ import annotations

import json
import re
from collections.abc import Mapping
from contextlib import suppress
from typing import Any, Final

from ruamel.yaml import YAML
from ruamel.yaml.error import YAMLError
from ruamel.yaml.events import AliasEvent, NodeEvent

from calib.errors import CalibError

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
    """Return a value in which each mapping of rows, cols and data is a list of rows."""
    if isinstance(value, list):
        return [_with_rows(one) for one in value]
    if not isinstance(value, Mapping):
        return value
    rows, columns, data = value.get("rows"), value.get("cols"), value.get("data")
    if isinstance(data, list) and isinstance(rows, int) and isinstance(columns, int) and len(data) == rows * columns:
        return [data[row * columns : (row + 1) * columns] for row in range(rows)]
    return {str(key): _with_rows(one) for key, one in value.items()}
