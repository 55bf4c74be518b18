"""Maps as binary PLY files: position, confidence, frames and age of each point."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np

from omnid.core.mapping.voxel_map import MapPoints
from omnid.errors import OmnidError
from omnid.formats.whole_file import write_whole

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
    """Write the points as binary little-endian PLY; the file is replaced at once, never written in part.

    Raises OmnidError if the file cannot be written.
    """
    vertices = np.empty(len(points.xyz), dtype=_VERTEX)
    for name in ("xyz", "confidence", "frames", "age"):
        vertices[name] = getattr(points, name)
    write_whole(Path(path), _HEADER.format(count=len(vertices)).encode("ascii") + vertices.tobytes())


def read_ply(path: str | Path) -> MapPoints:
    """Return the points of a file of `write_ply`; OmnidError for any other PLY."""
    try:
        raw = Path(path).read_bytes()
    except (OSError, ValueError) as error:  # ValueError: a NUL in the name
        raise OmnidError(f"{path}: cannot read the map: {error}") from error
    header = _HEADER_PATTERN.match(raw)
    if header is None:
        raise OmnidError(f"{path}: expected a PLY map written by omnid, found another header")
    body, expected = raw[header.end() :], int(header[1]) * _VERTEX.itemsize
    if len(body) != expected:
        raise OmnidError(
            f"{path}: expected {expected} bytes of points, found {len(body)}: the file is damaged, write the map again"
        )
    vertices = np.frombuffer(body, dtype=_VERTEX)
    return MapPoints(*(np.ascontiguousarray(vertices[name]) for name in ("xyz", "confidence", "frames", "age")))
