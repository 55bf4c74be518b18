"""Reader of the maps that omnid writes as PLY; it has its own description of the layout."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from omnid.core.mapping.voxel_map import MapPoints

VERTEX = np.dtype([("xyz", "<f4", 3), ("confidence", "<f4"), ("frames", "<i4"), ("age", "<i4")])


def read_ply(path: str | Path) -> MapPoints:
    """Return the points of a file of omnid.formats.exports."""
    head, _, body = Path(path).read_bytes().partition(b"end_header\n")
    assert head.startswith(b"ply\nformat binary_little_endian 1.0\n")
    vertices = np.frombuffer(body, VERTEX)
    return MapPoints(*(np.ascontiguousarray(vertices[name]) for name in ("xyz", "confidence", "frames", "age")))
