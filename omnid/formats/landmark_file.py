"""Files of landmarks: AprilTags with their places, seen in a map or known from a plan of the building.

    schema = 1
    [tag.dock]                   # any name
    id = 5
    size_m = 0.16                # edge of the black square
    xyz_m = [3.0, -1.25, 0.8]    # of its middle
    facing_deg = 90.0            # azimuth of the direction that it faces; left out for a tag on the floor

Names and sizes alone are enough to find the tags (`read_tags`).
"""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Final, TypeVar

from calib.errors import CalibError
from calib.validation import ValidatedTable, decode, read_bytes, require_schema, toml_table
from omnid.core.places.alignment import Landmark
from omnid.core.places.map_tags import MapTag
from omnid.core.places.tags import MAX_NAME, MAX_TAG, SIZES_M
from omnid.errors import OmnidError
from omnid.formats.whole_file import write_whole

SCHEMA: Final = 1
MAX_BYTES: Final = 1 << 18
Tag = TypeVar("Tag", Landmark, MapTag)


def write_landmarks(path: Path, landmarks: Iterable[Landmark]) -> None:
    """Write the file. Raises OmnidError if that is impossible."""
    lines, marks = [f"schema = {SCHEMA}"], list(landmarks)
    if not marks:
        lines += ["", "[tag]"]  # an empty table, as one is expected
    for mark in marks:
        lines += [
            "",
            # TOML has no escapes of surrogate pairs, which JSON in ASCII uses for letters beyond U+FFFF.
            f"[tag.{json.dumps(mark.name, ensure_ascii=False)}]",
            f"id = {mark.id}",
            f"size_m = {mark.size_m!r}",
            f"xyz_m = [{', '.join(f'{value:.4f}' for value in mark.xyz_m)}]",
        ]
        if mark.facing_rad is not None:
            lines.append(f"facing_deg = {math.degrees(mark.facing_rad):.2f}")
    write_whole(path, ("\n".join(lines) + "\n").encode())


def read_landmarks(path: Path) -> dict[int, Landmark]:
    """Return the landmarks by the numbers of their tags. Raises OmnidError, in one line."""
    return _read(path, _landmark)


def read_tags(path: Path) -> dict[int, MapTag]:
    """Return the tags of a file by their numbers; places need not be given. Raises OmnidError, in one line."""
    return _read(path, _tag)


def _read(path: Path, parsed: Callable[[ValidatedTable, str], Tag]) -> dict[int, Tag]:
    try:
        top = toml_table(decode(read_bytes(path, MAX_BYTES), str(path)), str(path))
        top.allow_only(("schema", "tag"))
        require_schema(top, SCHEMA)
        tags = top.table("tag")
        marks = [parsed(tags.table(name), name) for name in tags.values]
    except CalibError as error:
        raise OmnidError(str(error)) from None
    found = {mark.id: mark for mark in marks}
    if len(found) < len(marks):
        raise OmnidError(f"{path}: two landmarks have the same id: give each tag once")
    return found


def _landmark(table: ValidatedTable, name: str) -> Landmark:
    tag = _tag(table, name)
    x, y, z = table.numbers("xyz_m", 3)
    facing = math.radians(table.number("facing_deg")) if table.has("facing_deg") else None
    return Landmark(tag.name, tag.id, tag.size_m, (x, y, z), facing)


def _tag(table: ValidatedTable, name: str) -> MapTag:
    table.allow_only(("id", "size_m", "xyz_m", "facing_deg"))
    id, size_m = table.values.get("id"), table.number("size_m")
    if type(id) is not int or not 0 <= id <= MAX_TAG:
        table.fail("id", f"a number of 0 to {MAX_TAG}")
    if not SIZES_M[0] <= size_m <= SIZES_M[1]:
        table.fail("size_m", f"an edge of {SIZES_M[0]:g} to {SIZES_M[1]:g} m")
    if not 0 < len(name) <= MAX_NAME or not name.isprintable():
        raise OmnidError(f"{table.file}: {table.path!r}: expected a name of 1 to {MAX_NAME} printable characters")
    return MapTag(id, name, size_m)
