"""Channels to browsers, one for each kind of message. A browser is sent the newest version that it has not seen."""

from __future__ import annotations

import json
import math
from collections.abc import Callable
from typing import Any, Final, NamedTuple, Protocol

from omnid.core.mapping.thinned_path import ThinnedPath

MOST_POINTS: Final = 4000  # Most points of the path.
_FINEST_M: Final = 0.02  # Points of the path are at least this far apart, so that a robot at rest adds none.
_LARGEST_M: Final = 1e6  # Largest coordinate that is drawn.
_GAP_M: Final = 1.0  # A larger distance between two poses is drawn as a gap.

Encoded = str | bytes  # text is JSON; bytes are those of `with_header`


class BrowserChannel(Protocol):
    """One kind of message."""

    name: str
    version: int  # grows with each message; 0 before the first

    def message(self, seen: int) -> Encoded:
        """Return the newest message for a browser that has seen that version, 0 if none."""


class Newest:
    """A channel of which only the newest message counts; it is encoded when the first browser needs it."""

    def __init__(self, name: str, encode: Callable[[], Encoded]) -> None:
        self.name, self.version = name, 0
        self._encode = encode
        self._encoded: tuple[int, Encoded] = 0, ""

    def changed(self) -> None:
        """Note that there is something new to send."""
        self.version += 1

    def message(self, seen: int) -> Encoded:
        """Return the message as it is now."""
        if self._encoded[0] != self.version:
            self._encoded = self.version, self._encode()
        return self._encoded[1]


class Stored(Newest):
    """A channel of messages that are encoded as they come."""

    def __init__(self, name: str) -> None:
        super().__init__(name, lambda: self._message)
        self._message: Encoded = ""

    def set(self, message: Encoded) -> None:
        """Take the newest message."""
        self._message = message
        self.changed()


class _PathPoint(NamedTuple):
    x_m: float
    y_m: float
    after_gap: bool  # the robot was put elsewhere before it


def _is_step(last: _PathPoint, new: _PathPoint, step_m: float) -> bool:
    return new.after_gap or math.dist(last[:2], new[:2]) >= step_m


def _with_gap(dropped: _PathPoint, new: _PathPoint) -> _PathPoint:
    return new._replace(after_gap=dropped.after_gap or new.after_gap)


class LivePath:
    """The path of the robot; a browser is sent the points that it has not seen."""

    def __init__(self) -> None:
        self.name, self.version = "path", 0
        self._first = 0  # Version before the first point; a browser that has seen an older one is sent all points.
        self._path = ThinnedPath(MOST_POINTS, _FINEST_M, _is_step, _with_gap)

    def add(self, x_m: float, y_m: float, gap: bool = False) -> bool:
        """Add a position, m; return True if it is a new point. gap: the robot was put elsewhere."""
        if not (abs(x_m) < _LARGEST_M and abs(y_m) < _LARGEST_M):
            return False
        path = self._path
        if path.vertices:
            moved_m = math.dist(path.vertices[-1][:2], (x_m, y_m))
            gap = gap or moved_m > max(_GAP_M, 10 * path.step_m)
        else:
            gap = False
        times_thinned = path.thinned
        if not path.add(_PathPoint(x_m, y_m, gap)):
            return False
        if path.thinned == times_thinned:
            self.version += 1
        else:  # all are sent again: no browser has seen this version
            self._first = self.version + 1
            self.version = self._first + len(path.vertices)
        return True

    def clear(self) -> None:
        """Begin a new path: the robot has started again."""
        self._path.clear()
        self.version += 1
        self._first = self.version

    def message(self, seen: int) -> Encoded:
        """Return the points [x, y] added since that version, or all with `from` 0; after a gap [x, y, 1]."""
        begin = seen - self._first if seen >= self._first else 0
        points = [
            [round(point.x_m, 3), round(point.y_m, 3), *([1] if point.after_gap else [])]
            for point in self._path.vertices[begin:]
        ]
        return compact({"type": self.name, "from": begin, "points": points})


def compact(message: dict[str, Any]) -> str:
    """Return JSON without spaces; ValueError for numbers that are not finite, which JSON does not have."""
    return json.dumps(message, separators=(",", ":"), allow_nan=False)


def with_header(header: dict[str, Any], body: bytes) -> bytes:
    """Return a binary message: length of the header in 4 bytes, big-endian, the header in JSON, the body."""
    text = compact(header).encode()
    return len(text).to_bytes(4, "big") + text + body
