"""Requests to the navigation: goals, paths, routes, and words such as cancel; and its state. Parsers take any text."""

from __future__ import annotations

import re
from dataclasses import dataclass
from enum import StrEnum
from typing import Final, NamedTuple, TypeAlias

import numpy as np
from numpy.typing import NDArray

from omnid.core.navigation.route import Route
from omnid.errors import OmnidError

MAX_LOOPS: Final = 10_000  # Most rounds of a route, so that the number is bounded.
LONGEST_TEXT: Final = 200  # characters of a request; so that messages of any size are refused
LONGEST_NAME: Final = 64  # Characters of a route's name, so that its file has a valid name: at most 255 bytes.
_NAME: Final = re.compile(rf"[A-Za-z0-9][A-Za-z0-9_-]{{0,{LONGEST_NAME - 1}}}")
_LOOPS: Final = re.compile(r"loops=([1-9][0-9]{0,4})")
ROUTE_USAGE: Final = '"teach NAME [replace]", "finish", "repeat NAME [reverse] [loops=N]" or "stop"'


class NavigationFrame(StrEnum):
    """Frame of a goal or a path."""

    MAP = "map"
    ODOM = "odom"


class NavigationState(StrEnum):
    """State of a goal, a path or a route. The values are the words used on the bus and in logs."""

    IDLE = "idle"  # nothing has been asked for since the start
    DRIVING = "driving"
    AVOIDING = "avoiding"  # off the path, around an obstacle
    BLOCKED = "blocked"  # waits for the way to become free
    PAUSED = "paused"  # paused by a command, or by a fault that a person must see to; `resume` continues
    NOT_LOCALISED = "not localised"  # waits for the pose in the map
    REACHED = "reached"
    CANCELLED = "cancelled"
    FAILED = "failed"

    @property
    def is_end(self) -> bool:
        """True if nothing is under way: the wheels are given no setpoint."""
        return self in (self.IDLE, self.REACHED, self.CANCELLED, self.FAILED)


class NavigationVerb(StrEnum):
    """Requests about the present drive."""

    CANCEL = "cancel"
    PAUSE = "pause"
    RESUME = "resume"


class RouteAction(StrEnum):
    """Requests about routes."""

    TEACH = "teach"  # begin to record
    FINISH = "finish"  # the recording, and write it
    REPEAT = "repeat"
    STOP = "stop"  # the repetition, or the recording without a file


@dataclass(frozen=True, slots=True)
class GoalRequest:
    """Drive to a pose of the base."""

    frame: NavigationFrame
    x_m: float
    y_m: float
    heading_rad: float | None = None  # None: any heading


@dataclass(frozen=True, slots=True, eq=False)
class PathRequest:
    """Drive along a path."""

    frame: NavigationFrame
    xy: NDArray[np.float64]  # (N, 2) m
    heading_rad: float | None = None  # heading at the end; None: any


@dataclass(frozen=True, slots=True)
class RouteRequest:
    """Teach or repeat a route."""

    action: RouteAction
    name: str = ""
    reverse: bool = False
    loops: int = 1
    replace: bool = False  # teach in the place of a route of that name


@dataclass(frozen=True, slots=True, eq=False)
class TaughtRoute:
    """A route that is to be written."""

    route: Route
    id: int  # id of the request to finish the recording


NavigationRequest: TypeAlias = GoalRequest | PathRequest | NavigationVerb | RouteRequest


class NavigationCommand(NamedTuple):
    """A request and its times."""

    request: NavigationRequest
    arrival_ns: int  # Unix time
    stamp_ns: int = 0  # Unix time by the sender's clock; 0: it has none
    id: int = 0  # id of the request; the answer has the same
    # Stops and faults that had made cmd/arm necessary before the request: it begins no motion after a later one.
    stop_count: int = 0


def begins_nothing(request: NavigationRequest) -> bool:
    """True if a request ends or pauses what is under way, and begins no motion."""
    if isinstance(request, RouteRequest):
        return request.action in (RouteAction.FINISH, RouteAction.STOP)
    return request in (NavigationVerb.CANCEL, NavigationVerb.PAUSE)


def navigation_verb(text: str) -> NavigationVerb:
    """Return the verb of a text. Raise OmnidError for any other text."""
    word = text.strip() if len(text) <= LONGEST_TEXT else ""
    if word not in list(NavigationVerb):
        raise OmnidError(f"{_quoted(text)} is no request to the navigation: expected {', '.join(NavigationVerb)}")
    return NavigationVerb(word)


def route_name(text: str) -> str:
    """Return the name of a route, which can be part of a file name. Raise OmnidError for a text that cannot."""
    if not _NAME.fullmatch(text):
        raise OmnidError(
            f"{_quoted(text)} is no name of a route: expected letters, digits, '-' and '_', a letter or "
            f"digit first, at most {LONGEST_NAME}"
        )
    return text


def route_request(text: str) -> RouteRequest:
    """Parse a text as ROUTE_USAGE says. Raise OmnidError for any other text."""
    words = text.split() if len(text) <= LONGEST_TEXT else []
    match words:
        case ["finish" | "stop" as action]:
            return RouteRequest(RouteAction(action))
        case ["teach", name, *options] if options in ([], ["replace"]):
            return RouteRequest(RouteAction.TEACH, route_name(name), replace=bool(options))
        case ["repeat", name, *options] if len(options) == len({option.partition("=")[0] for option in options}):
            return _repeat_request(route_name(name), options, text)
    raise OmnidError(f"{_quoted(text)} is no request about routes: expected {ROUTE_USAGE}")


def _repeat_request(name: str, options: list[str], text: str) -> RouteRequest:
    loops = 1
    for option in options:
        found = _LOOPS.fullmatch(option)
        if found and int(found[1]) <= MAX_LOOPS:
            loops = int(found[1])
        elif option != "reverse":
            raise OmnidError(f"{_quoted(text)}: expected {ROUTE_USAGE}, N at most {MAX_LOOPS}")
    return RouteRequest(RouteAction.REPEAT, name, "reverse" in options, loops)


def _quoted(text: str) -> str:
    return ascii(text[:60])
