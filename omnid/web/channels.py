"""The kinds of messages for browsers. Each has a version; a browser is sent the newest one that it has not seen."""

from __future__ import annotations

import json
import math
from collections.abc import Callable
from typing import Any, Final, Protocol

MOST_POINTS: Final = 4000  # of the path
_FINEST_M: Final = 0.02
_LARGEST_M: Final = 1e6  # of a coordinate that is drawn
_GAP_M: Final = 1.0  # between two poses, from which the path is drawn with a gap

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


class LivePath:
    """The path of the robot: points at a spacing that doubles whenever there are too many; a browser is sent those
    that it has not seen.
    """

    def __init__(self) -> None:
        self.name, self.version = "path", 0
        self._first = 0  # version of the points before the first one; those who saw less are sent all
        self._points: list[tuple[float, float] | None] = []  # None: a gap
        self._step_m = _FINEST_M
        self._last: tuple[float, float] | None = None

    def add(self, x_m: float, y_m: float, gap: bool = False) -> bool:
        """Add a position, m; return True if it is a new point. gap: the robot was put elsewhere."""
        if not (abs(x_m) < _LARGEST_M and abs(y_m) < _LARGEST_M):
            return False
        moved_m = math.dist(self._last, (x_m, y_m)) if self._last else math.inf
        if not gap and moved_m < self._step_m:
            return False
        if (gap or moved_m > max(_GAP_M, 10 * self._step_m)) and self._points and self._points[-1] is not None:
            self._append(None)
        self._append((x_m, y_m))
        while len(self._points) > MOST_POINTS:
            self._coarsen()
        return True

    def clear(self) -> None:
        """Begin a new path: the robot has started again."""
        self._points, self._last, self._step_m = [], None, _FINEST_M
        self.version += 1
        self._first = self.version

    def message(self, seen: int) -> Encoded:
        """Return the points that were added since that version, or all with `from` 0."""
        begin = seen - self._first if seen >= self._first else 0
        points = [None if point is None else [round(point[0], 3), round(point[1], 3)]
                  for point in self._points[begin:]]
        return compact({"type": self.name, "from": begin, "points": points})

    def _append(self, point: tuple[float, float] | None) -> None:
        self._points.append(point)
        self._last = point or self._last
        self.version += 1

    def _coarsen(self) -> None:
        """Leave out points that are closer together than twice the spacing; all others are sent again."""
        points, self._points, self._step_m = self._points, [], 2 * self._step_m
        last: tuple[float, float] | None = None
        for point in points:
            if point is None and self._points and self._points[-1] is not None:
                self._points.append(None)
            elif point is not None and (last is None or math.dist(last, point) >= self._step_m):
                self._points.append(point)
                last = point
        self._first = self.version + 1  # no browser has seen that
        self.version = self._first + len(self._points)


def compact(message: dict[str, Any]) -> str:
    """Return JSON without spaces; ValueError for numbers that are not finite, which JSON does not have."""
    return json.dumps(message, separators=(",", ":"), allow_nan=False)


def with_header(header: dict[str, Any], body: bytes) -> bytes:
    """Return a binary message: length of the header in 4 bytes, big-endian, the header in JSON, the body."""
    text = compact(header).encode()
    return len(text).to_bytes(4, "big") + text + body
