"""Files for other programs, replaced at once, never written in part.

Points are binary PLY: position, confidence, frames and age. Occupancy grids are those of ROS's map_server and nav2: a
PGM image and a YAML file that describes it.
"""

from __future__ import annotations

import json
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np

from calib.atomic_file import replacement
from omnid.core.mapping.scan_grid import FREE, OCCUPIED, Grid
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
_WHITE, _BLACK, _GREY = 254, 0, 205  # free, occupied and unknown, as map_saver writes them
# With nav2's default of 0.25, grey (255 - 205) / 255 = 0.196 would count as free.
_YAML = """image: {image}
mode: trinary
resolution: {cell_m:.6g}
origin: [{x:.6f}, {y:.6f}, 0.0]
negate: 0
occupied_thresh: 0.65
free_thresh: 0.196
"""


@contextmanager
def replaced(path: Path, content: str = "file") -> Iterator[Path]:
    """Yield a temporary file that takes the place of the file at the end of the block, see `calib.atomic_file`.

    content: for the error. Raises OmnidError where the file cannot be written.
    """
    try:
        with replacement(path) as partial:
            yield partial
    except (OSError, ValueError) as error:  # ValueError: a NUL in the name, or content that is refused
        raise OmnidError(f"{path}: cannot write the {content}: {error}: choose another file") from error


def write_whole(path: Path, content: bytes) -> None:
    """Write a file whole. Raises OmnidError if that is impossible."""
    with replaced(path) as partial:
        partial.write_bytes(content)


def write_ply(path: str | Path, points: MapPoints) -> None:
    """Write the points as binary little-endian PLY. Raises OmnidError if the file cannot be written."""
    vertices = np.empty(len(points.xyz), dtype=_VERTEX)
    for name in _VERTEX.names or ():
        vertices[name] = getattr(points, name)
    write_whole(Path(path), _HEADER.format(count=len(vertices)).encode("ascii") + vertices.tobytes())


def write_grid(path: Path, grid: Grid) -> None:
    """Write `path`, which ends in .yaml, and the image in the same folder, whose name ends in .pgm.

    Raises OmnidError if they cannot be written.
    """
    if path.suffix not in (".yaml", ".yml"):
        raise OmnidError(f"{path}: expected a name that ends in .yaml; the image gets the same name with .pgm")
    pixels = path.with_suffix(".pgm")
    x, y = grid.corner
    # A string of JSON is one of YAML.
    text = _YAML.format(image=json.dumps(pixels.name), cell_m=grid.cell_m, x=x, y=y)
    image = np.select([grid.cells == FREE, grid.cells == OCCUPIED], [_WHITE, _BLACK], _GREY).astype(np.uint8)
    height, width = image.shape
    # Both are on the disk before one takes its name: an image next to the text of another map would be shifted.
    with replaced(pixels, "map") as new_image, replaced(path, "map") as new_text:
        # The first row is the highest y.
        new_image.write_bytes(b"P5\n%d %d\n255\n" % (width, height) + image[::-1].tobytes())
        new_text.write_text(text)
