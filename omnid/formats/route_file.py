"""Route files (.route.json, see docs/formats.md): written whole, read strictly, whatever their bytes."""

from __future__ import annotations

import json
import zlib
from pathlib import Path
from typing import Any, Final

import numpy as np

from omnid.core.navigation.path import FARTHEST_M
from omnid.core.navigation.requests import route_name
from omnid.core.navigation.route import DECIMALS, MOST_POINTS, Route
from omnid.core.places.place_map import NO_KEYFRAME
from omnid.errors import OmnidError
from omnid.formats.whole_file import write_whole

FORMAT: Final = "omnid route"
VERSION: Final = 1
SUFFIX: Final = ".route.json"
# Limits of what is read, so that any file is refused in bounded time and memory. The longest route that can be taught
# has MOST_POINTS points and one keyframe at most for each of them, which is less than 4 MB.
MAX_BYTES: Final = 8 << 20
MOST_KEYFRAMES: Final = 20_000
# Speeds and turns that no robot on wheels has are those of a damaged file.
FASTEST_MPS: Final = 20.0
COLUMNS: Final = (
    "x_m",
    "y_m",
    "yaw_rad",
    "speed_mps",
    "keyframe",
    "in_keyframe_x_m",
    "in_keyframe_y_m",
    "in_keyframe_yaw_rad",
)
_KEYS: Final = {"format", "version", "name", "created_s", "map", "columns", "points", "keyframes", "crc32"}


def route_bytes(route: Route) -> bytes:
    """Return the content of a route's file."""
    rows = np.column_stack([route.poses, route.speeds, route.keyframes, route.in_keyframe]).round(DECIMALS).tolist()
    points = [[int(v) if k == 4 else v for k, v in enumerate(row)] for row in rows]
    keyframes = [[int(id), int(stamp)] for id, stamp in sorted(route.stamps_ns.items())]
    content = {
        "format": FORMAT,
        "version": VERSION,
        "name": route.name,
        "created_s": route.created_s,
        "map": route.map_name,
        "columns": list(COLUMNS),
        "points": points,
        "keyframes": keyframes,
        "crc32": _checksum(route.name, points, keyframes),
    }
    return (json.dumps(content, separators=(",", ":"), allow_nan=False) + "\n").encode()


def parse_route(content: bytes, name: str) -> Route:
    """Return the route of a file; name: for errors. Raise OmnidError for any other bytes."""
    if len(content) > MAX_BYTES:
        raise OmnidError(f"{name}: {len(content) >> 20} MB: expected a route of at most {MAX_BYTES >> 20} MB")
    try:
        found = json.loads(content)
    except (ValueError, RecursionError):
        raise OmnidError(f"{name}: this is no route file: expected JSON, see docs/formats.md") from None
    if not isinstance(found, dict) or found.get("format") != FORMAT:
        raise OmnidError(f'{name}: this is no route file: expected "format": "{FORMAT}"')
    if found.get("version") != VERSION:
        raise OmnidError(
            f"{name}: this is a route of version {ascii(found.get('version'))[:20]}, expected {VERSION}: "
            "teach it again, or update omnid"
        )
    try:
        return _route(found)
    except OmnidError as error:
        raise OmnidError(f"{name}: the route is damaged: {error}: teach it again") from None


def _route(found: dict[str, Any]) -> Route:
    """Return the route of a file's content. Raise OmnidError with what is wrong."""
    _require(found.keys() == _KEYS and found["columns"] == list(COLUMNS), "its keys are not those of a route")
    title, map_name = found["name"], found["map"]
    _require(isinstance(title, str) and isinstance(map_name, str) and len(map_name) <= 4096, "its names are no texts")
    points = _rows(found["points"], len(COLUMNS), MOST_POINTS)
    keyframes = _rows(found["keyframes"], 2, MOST_KEYFRAMES)
    _require(all(type(v) is int and 0 <= v < 2**62 for row in keyframes for v in row), "its keyframes are no numbers")
    _require(len(points) >= 2, "it has no points")
    _require(all(type(row[4]) is int and NO_KEYFRAME <= row[4] < 2**62 for row in points), "a keyframe is no number")
    _require(found["crc32"] == _checksum(title, points, keyframes), "the checksum is wrong")
    numbers = np.array(points, np.float64)
    _require(bool(np.isfinite(numbers).all()), "a number is not finite")
    _require(
        float(np.abs(numbers[:, [0, 1, 5, 6]]).max()) <= FARTHEST_M
        and float(np.abs(numbers[:, [2, 7]]).max()) <= 1e4
        and float(np.abs(numbers[:, 3]).max()) <= FASTEST_MPS,
        "a number is out of range",
    )
    created = found["created_s"]
    _require(type(created) is int and 0 <= created < 2**40, "its time is no number")
    return Route(
        route_name(title),
        numbers[:, :3],
        numbers[:, 3],
        np.array([row[4] for row in points], np.int64),
        numbers[:, 5:],
        {id: stamp for id, stamp in keyframes},
        created,
        map_name,
    )


def _rows(value: Any, width: int, most: int) -> list[list[Any]]:
    """Return a value if it is a list of at most `most` rows of `width` numbers. Raise OmnidError for any other."""
    _require(isinstance(value, list) and len(value) <= most, f"expected a list of at most {most} rows")
    for row in value:
        _require(
            isinstance(row, list)
            and len(row) == width
            and all(type(v) in (int, float) and abs(v) < 2.0**63 for v in row),
            f"expected {width} numbers a row",
        )
    return list(value)


def _require(holds: bool, text: str) -> None:
    if not holds:
        raise OmnidError(text)


def _checksum(name: str, points: list[list[Any]], keyframes: list[list[Any]]) -> int:
    return zlib.crc32(json.dumps([name, points, keyframes], separators=(",", ":")).encode())


class RouteFolder:
    """The routes of a robot: a file each in one folder."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder

    def path(self, name: str) -> Path:
        """Return the path of a route's file. Raise OmnidError where `name` is not a valid name."""
        return self.folder / f"{route_name(name)}{SUFFIX}"

    def names(self) -> list[str]:
        """Return the names of all routes, sorted."""
        return sorted(
            path.name.removesuffix(SUFFIX) for path in self.folder.glob(f"*{SUFFIX}") if not path.name.startswith(".")
        )

    def has(self, name: str) -> bool:
        """True if there is a file for a route of that name, readable or not."""
        return self.path(name).exists()

    def read(self, name: str) -> Route:
        """Return a route. Raise OmnidError where there is none, or where its file is damaged."""
        path = self.path(name)
        try:
            with path.open("rb") as file:
                content = file.read(MAX_BYTES + 1)
        except FileNotFoundError:
            known = ", ".join(self.names()[:20]) or "none"
            raise OmnidError(f"no route {name} in {self.folder}: there are: {known}") from None
        except OSError as error:
            raise OmnidError(f"{path}: cannot read the route: {error.strerror or error}") from None
        route = parse_route(content, str(path))
        if route.name != name:
            raise OmnidError(f"{path}: this is the route {route.name}: name the file {route.name}{SUFFIX}")
        return route

    def write(self, route: Route) -> None:
        """Write a route; one of the same name is replaced. Raise OmnidError where it cannot be written."""
        try:
            self.folder.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise OmnidError(
                f"{self.folder}: cannot make the folder of the routes: {error.strerror or error}: change "
                "navigation.routes"
            ) from None
        write_whole(self.path(route.name), route_bytes(route))

    def delete(self, name: str) -> None:
        """Delete a route. Raise OmnidError where there is none."""
        try:
            self.path(name).unlink()
        except FileNotFoundError:
            raise OmnidError(f"no route {name} in {self.folder}: nothing was deleted") from None
        except OSError as error:
            raise OmnidError(f"{self.path(name)}: cannot delete the route: {error.strerror or error}") from None
