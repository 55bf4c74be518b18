"""Maps as binary PLY files: position, confidence, frames and age of each point."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from omnid.core.mapping.voxel_map import MapPoints
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


def write_ply(path: str | Path, points: MapPoints) -> None:
    """Write the points as binary little-endian PLY; the file is replaced at once, never written in part.

    Raises OmnidError if the file cannot be written.
    """
    vertices = np.empty(len(points.xyz), dtype=_VERTEX)
    for name in ("xyz", "confidence", "frames", "age"):
        vertices[name] = getattr(points, name)
    write_whole(Path(path), _HEADER.format(count=len(vertices)).encode("ascii") + vertices.tobytes())
