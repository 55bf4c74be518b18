"""The map as a binary PLY file: position, confidence, frames and age of each point."""

from __future__ import annotations

import os
import re
from pathlib import Path

import numpy as np

from omnid.core.mapping.voxel_map import MapPoints
from omnid.errors import OmnidError

_VERTEX = np.dtype([("xyz", "<f4", 3), ("confidence", "<f4"), ("frames", "<i4"), ("age", "<i4")])
_HEADER = """ply
format binary_little_endian 1.0
comment omnid map: metres, x forward, y left, z up; confidence 0 to 1; age in frames
element vertex {count}
property float x
property float y
property float z
property float confidence
property int frames
property int age
end_header
"""
_HEADER_PATTERN = re.compile(re.escape(_HEADER).replace(r"\{count\}", r"(\d{1,12})").encode("ascii"))


def write_ply(path: str | Path, points: MapPoints) -> None:
    """Write the points as binary little-endian PLY; a reader sees the old file or the whole new one, never a part.

    Raises OmnidError where the file cannot be written.
    """
    vertices = np.empty(len(points.xyz), dtype=_VERTEX)
    for name in ("xyz", "confidence", "frames", "age"):
        vertices[name] = getattr(points, name)
    _replace(Path(path), _HEADER.format(count=len(vertices)).encode("ascii") + vertices.tobytes())


def read_ply(path: str | Path) -> MapPoints:
    """The points of a file of `write_ply`; any other PLY is refused with OmnidError."""
    try:
        raw = Path(path).read_bytes()
    except (OSError, ValueError) as error:  # ValueError: a NUL in the name
        raise OmnidError(f"{path}: a map was asked for, it cannot be read: {error}") from error
    header = _HEADER_PATTERN.match(raw)
    if header is None:
        raise OmnidError(f"{path}: a PLY map of omnid was expected, found another header: only its own are read")
    body, expected = raw[header.end() :], int(header[1]) * _VERTEX.itemsize
    if len(body) != expected:
        raise OmnidError(f"{path}: {expected} bytes of points were expected, {len(body)} found: write the map again")
    vertices = np.frombuffer(body, dtype=_VERTEX)
    return MapPoints(*(np.ascontiguousarray(vertices[name]) for name in ("xyz", "confidence", "frames", "age")))


def _replace(path: Path, content: bytes) -> None:
    try:
        beside = path.with_name(f".{path.name}.{os.getpid()}.part")  # the same file system, or the rename is no rename
        try:
            with beside.open("wb") as file:
                file.write(content)
                file.flush()
                os.fsync(file.fileno())  # a robot is switched off without a word
            os.replace(beside, path)
        finally:
            beside.unlink(missing_ok=True)
    except (OSError, ValueError) as error:
        raise OmnidError(f"{path}: a map was to be written, it cannot be: {error}: choose another file") from error
