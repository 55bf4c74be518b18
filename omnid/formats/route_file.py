"""Route files (.route.json, see docs/formats.md): written whole, read strictly, whatever their bytes."""

from __future__ import annotations

import json
import zlib
from pathlib import Path
from typing import Annotated, Any, Final, Literal, TypeAlias

import msgspec
import numpy as np
from msgspec import Meta, Struct

from drivers.logs.log import LATEST_NS
from omnid.core.navigation.path import FARTHEST_M
from omnid.core.navigation.requests import route_name
from omnid.core.navigation.route import MOST_POINTS, Route
from omnid.core.places.place_map import NO_KEYFRAME
from omnid.errors import OmnidError
from omnid.formats.exports import write_whole

SUFFIX: Final = ".route.json"
# Limit of what is read: the longest route that can be taught, of MOST_POINTS points, has less than 4 MB.
MAX_BYTES: Final = 8 << 20
DECIMALS: Final = 6  # micrometres
_PARTS: Final = ("x_m", "y_m", "yaw_rad")
COLUMNS: Final = [*_PARTS, "speed_mps", "keyframe", *(f"in_keyframe_{part}" for part in _PARTS)]

_Number: TypeAlias = Annotated[float, Meta(ge=-FARTHEST_M, le=FARTHEST_M)]
_Count: TypeAlias = Annotated[int, Meta(gt=NO_KEYFRAME, lt=LATEST_NS)]
_Keyframe: TypeAlias = Annotated[int, Meta(ge=NO_KEYFRAME, lt=LATEST_NS)]
# The COLUMNS.
_Point: TypeAlias = tuple[_Number, _Number, _Number, _Number, _Keyframe, _Number, _Number, _Number]


class _Content(Struct, forbid_unknown_fields=True):
    """A file."""

    format: Literal["omnid route"]
    version: Literal[1]
    name: str
    created_s: Annotated[int, Meta(ge=0, lt=1 << 37)]
    map: str
    columns: list[str]
    points: Annotated[list[_Point], Meta(min_length=2, max_length=MOST_POINTS)]
    keyframes: Annotated[list[tuple[_Count, _Count]], Meta(max_length=MOST_POINTS)]  # id, stamp [ns]
    crc32: int

    def checksum(self) -> int:
        """Return the checksum of name, points and keyframes."""
        return zlib.crc32(_text([self.name, self.points, self.keyframes]))


def _text(content: Any) -> bytes:
    return json.dumps(content, separators=(",", ":"), allow_nan=False).encode()


def route_bytes(route: Route) -> bytes:
    """Return the content of a route's file."""
    numbers = np.column_stack([route.poses, route.speeds, route.keyframes, route.in_keyframe]).round(DECIMALS)
    points = [(*row[:4], int(row[4]), *row[5:]) for row in numbers.tolist()]
    keyframes = [(int(id), int(stamp)) for id, stamp in sorted(route.stamps_ns.items())]
    about = route.name, route.created_s, route.map_name
    content = _Content("omnid route", 1, *about, COLUMNS, points, keyframes, crc32=0)
    content.crc32 = content.checksum()
    return _text(msgspec.structs.asdict(content)) + b"\n"


def parse_route(content: bytes, name: str) -> Route:
    """Return the route of a file; name: for errors. Raise OmnidError for any other bytes."""
    try:
        if len(content) > MAX_BYTES:
            raise OmnidError(f"it has more than {MAX_BYTES >> 20} MB")
        found = msgspec.json.decode(content, type=_Content)
        if found.columns != COLUMNS:
            raise OmnidError(f"expected the columns {', '.join(COLUMNS)}")
        if found.crc32 != found.checksum():
            raise OmnidError("the checksum is wrong")
        numbers, keyframes = np.array(found.points, np.float64), np.array([point[4] for point in found.points])
        points = numbers[:, :3], numbers[:, 3], keyframes, numbers[:, 5:]
        return Route(route_name(found.name), *points, dict(found.keyframes), found.created_s, found.map)
    except (msgspec.DecodeError, UnicodeDecodeError, RecursionError, OmnidError) as error:
        raise OmnidError(f"{name}: this is no route of version 1, or a damaged one: {error}: teach it again") from None


class RouteFolder:
    """The routes of a robot: a file each in one folder."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder

    def path(self, name: str) -> Path:
        """Return the path of a route's file. Raise OmnidError where `name` is not a valid name."""
        return self.folder / f"{route_name(name)}{SUFFIX}"

    def names(self) -> list[str]:
        """Return the names of all routes, sorted."""
        return sorted(path.name.removesuffix(SUFFIX) for path in self.folder.glob(f"[!.]*{SUFFIX}"))

    def read(self, name: str) -> Route:
        """Return a route. Raise OmnidError where there is none, or where its file is damaged."""
        path = self.path(name)
        try:
            with path.open("rb") as file:
                content = file.read(MAX_BYTES + 1)
        except OSError as error:
            known = ", ".join(self.names()[:20]) or "none"
            raise OmnidError(f"{path}: cannot read the route: {error.strerror}; routes there: {known}") from None
        route = parse_route(content, str(path))
        if route.name != name:
            raise OmnidError(f"{path}: this is the route {route.name}: name the file {route.name}{SUFFIX}")
        return route

    def write(self, route: Route) -> None:
        """Write a route; one of the same name is replaced. Raise OmnidError where it cannot be written."""
        try:
            self.folder.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise OmnidError(f"{self.folder}: cannot make the folder of navigation.routes: {error.strerror}") from None
        write_whole(self.path(route.name), route_bytes(route))
